"""RSSI at the receivers asked for, at positions nobody measured: SwiftWRF against what practitioners use."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pandas import DataFrame
from PIL import Image, UnidentifiedImageError

from swiftwrf import InputError, Rssi, load_rssi, rssi_room
from swiftwrf.data.files import sha256
from swiftwrf.data.splits import validation_for
from swiftwrf.positions import distance
from swiftwrf.rssi import LEVEL
from tasks.cluster import connected
from tasks.metrics import PredictorMetrics, PredictorSeconds, ReceiverMetrics, RssiMetrics
from tasks.page.page import reporting
from tasks.rssi.page import page
from tasks.rssi.predictors import PREDICTORS, SLOW, Settings, lacks
from tasks.rssi.predictors.swiftwrf import SwiftWRFPredictor
from tasks.run import Preset, Row, Run, choose_device, console
from tasks.source import TableSource, reading
from tasks.summarise import error_summary, grouped

MODEL = "model.safetensors"
MAP_CELLS = 80  # along the longer side of the floor
MOST_PLAN_PIXELS = 2**24


@dataclass(frozen=True)
class RssiTaskConfig(TableSource):
    """RSSI of a moving transmitter at fixed receivers, against baselines.

    Without --data the built-in simulated floor is used. An interrupted run goes on with --resume DIR.partial, here or where
    a --scheduler beside it says.
    """

    rx: tuple[str, ...]
    """receivers: names, numbers counted from 1, or all"""
    data: str | None = None
    """survey table (CSV or Parquet), or folder with tx_pos.csv, gateway_rssi.csv and gateway_position.yml (NeRF2 layout)"""
    split: str = "random"
    """a split that comes with the data, or a seeded one: random or block"""
    also: tuple[str, ...] = ()
    """predictors that take minutes and are compared only when named: nerf2, blend"""
    preset: Preset = "quick"
    """of SwiftWRF: quick corrects a log-distance law; paper is the plain head"""
    floor_plan: str | None = None
    """an image to draw behind the maps, PNG or JPEG"""
    floor_extent: tuple[float, float, float, float] | None = None
    """x0 x1 y0 y1 of that image [m]"""
    scheduler: str | None = None
    """address of a Dask scheduler whose workers fit groups of receivers (extra: cluster)"""
    seed: int = 0
    """of everything random"""
    out: str | None = None
    """directory of the run; must not exist (default: a new one under runs/rssi)"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """where to compute; RSSI models are small, so auto is the CPU"""


def run(config: RssiTaskConfig, resume: Path | None = None) -> None:
    """Runs the experiment and writes its directory, or goes on with an interrupted one.

    Raises:
        InputError: what the configuration asks for is not there or makes no sense.
    """
    device = choose_device("cpu" if config.device == "auto" else config.device)
    for name in config.also:
        PREDICTORS[name]  # refuses an unknown one
    plan = _read_floor_plan(config)
    whole = _load(config)
    data, (pool, _) = whole.receivers(config.rx), whole.split(config.split, config.seed)
    for note in data.notes:
        console.print(f"{data.name}: {note}")
    train, test = data.split(config.split, config.seed)
    if not bool((~test.rssi_dbm.isnan()).any()):
        raise InputError(f"split {config.split!r} of {data.name} has no heard test rows for these receivers")
    label = f"rx{'_'.join(config.rx)}-s{config.seed}"
    source = data.source | ({"floor plan": sha256(Path(config.floor_plan))} if config.floor_plan else {})
    with (
        connected(config.scheduler, device) as cluster,
        Run("rssi", config.out, label, config, device, source, resume) as directory,
    ):
        parallel = cluster.map if cluster else map
        settings = Settings(validation_for(config.split), config.seed, config.preset, device, parallel, pool)
        tables = _Tables(data, train, test, plan, directory, settings)
        compared = [name for name in PREDICTORS if name not in SLOW or name in config.also]
        left_out = {name: reason for name in compared if (reason := lacks(name, data))}
        for name in compared:
            if name in left_out:
                console.print(f"left out: {left_out[name]}")
            else:
                tables.add(name)
        directory.computed_on(cluster.machines if cluster else ())
        directory.write_csv("errors.csv", tables.errors)
        directory.write_csv("predictions.csv", tables.predictions)
        metrics: RssiMetrics = {
            "task": "rssi",
            "data": data.name,
            "split": config.split,
            "preset": config.preset,
            "seed": config.seed,
            "n_train": len(train),
            "n_test": len(test),
            "overall": tables.overall(),
            "left_out": left_out,
            "receivers": tables.receivers(),
            "seconds": tables.seconds["swiftwrf"],
            "interval": {"nominal": LEVEL, "coverage": tables.coverage},
            "chosen": {"n_primitives": tables.n_primitives},
        }
        final = directory.finish(metrics, reporting(page))
    console.print(f"report: [bold]{final / 'report.html'}[/]")


def _load(config: RssiTaskConfig) -> Rssi:
    if config.data is None:
        if config.columns:
            raise InputError("--columns is for a survey table; give it with --data")
        return rssi_room(seed=config.seed)
    return load_rssi(config.data, columns=reading(config).columns)


def _read_floor_plan(config: RssiTaskConfig) -> dict[str, Any]:
    """The floor plan and where it lies, as maps.npz keeps them; nothing where there is none."""
    if (config.floor_plan is None) != (config.floor_extent is None):
        raise InputError("--floor-plan needs --floor-extent x0 x1 y0 y1 [m], and the other way round")
    if config.floor_plan is None or config.floor_extent is None:
        return {}
    x0, x1, y0, y1 = config.floor_extent
    if not (x0 < x1 and y0 < y1):
        raise InputError(f"--floor-extent must be x0 x1 y0 y1 with x0 < x1 and y0 < y1, got {config.floor_extent}")
    try:
        # few formats, for Pillow starts other programs for some; the pixels now, for a file may end before they do
        with Image.open(config.floor_plan, formats=("PNG", "JPEG")) as image:
            if image.width * image.height > MOST_PLAN_PIXELS:
                raise InputError(
                    f"--floor-plan {config.floor_plan} has {image.width} x {image.height} pixels; give one of at most "
                    f"{MOST_PLAN_PIXELS}"
                )
            return {"plan": np.asarray(image.convert("RGB")), "plan_extent": np.array(config.floor_extent)}
    except InputError:
        raise
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise InputError(f"--floor-plan {config.floor_plan} is not a readable image, PNG or JPEG ({error})") from None


def _rows(**columns: torch.Tensor | list[str]) -> list[Row]:
    """The rows of a table with these columns."""
    values = (c.tolist() if isinstance(c, torch.Tensor) else c for c in columns.values())
    return [dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True)]


class _Tables:
    """Fits and tests every predictor, each a step of the run's directory, and gathers the tables of the run."""

    def __init__(
        self, data: Rssi, train: Rssi, test: Rssi, plan: dict[str, Any], directory: Run, settings: Settings
    ) -> None:
        self.train, self.test, self.plan, self.directory, self.settings = train, test, plan, directory, settings
        self.errors: list[Row] = []
        self.predictions: list[Row] = []
        self.seconds: dict[str, PredictorSeconds] = {}
        self.coverage = float("nan")
        self.n_primitives = 0
        self.heard = ~test.rssi_dbm.isnan()
        self.row, column = self.heard.nonzero(as_tuple=True)
        self.receiver = [test.receiver_names[number] for number in column.tolist()]
        test_position = test.transmitter_position
        self.from_receiver = distance(test_position, data.receiver_position)
        self.from_training = distance(test_position, train.transmitter_position).min(dim=1).values

    def add(self, name: str) -> None:
        """One predictor."""

        def compute() -> Row:
            predictor = PREDICTORS[name].make(self.settings)
            began = time.perf_counter()
            predictor.fit(self.train)
            fitted = time.perf_counter()
            result: Row = {"predicted": predictor.predict(self.test.transmitter_position)}
            result |= {"fit": fitted - began, "predict": time.perf_counter() - fitted}
            if isinstance(predictor, SwiftWRFPredictor):
                _, low, high = predictor.model.predict(self.test.transmitter_position)
                result |= {"low": low, "high": high, "n_primitives": predictor.model.n_primitives}
                predictor.model.save(self.directory.path(MODEL))
                self._keep_maps(predictor)
            return result

        value = self.directory.step(name, compute)
        self.seconds[name] = {"fit": value["fit"], "predict": value["predict"]}
        predicted = torch.tensor(value["predicted"], dtype=torch.float64)
        measured = self.test.rssi_dbm
        self.errors += _rows(
            method=[name] * len(self.row),
            receiver=self.receiver,
            index=self.test.index[self.row],
            measured_dbm=measured[self.heard],
            predicted_dbm=predicted[self.heard],
            abs_error_db=(predicted - measured)[self.heard].abs(),
            from_receiver_m=self.from_receiver[self.heard],
            from_training_m=self.from_training[self.row],
        )
        if name == "swiftwrf":
            self._predict_rows(predicted, torch.tensor(value["low"]), torch.tensor(value["high"]))
            self.n_primitives = value["n_primitives"]

    def _predict_rows(self, predicted: torch.Tensor, low: torch.Tensor, high: torch.Tensor) -> None:
        measured, heard = self.test.rssi_dbm, self.heard
        self.coverage = float(((measured >= low) & (measured <= high))[heard].double().mean())
        x, y, z = self.test.transmitter_position[self.row].unbind(dim=1)
        self.predictions += _rows(
            x=x,
            y=y,
            z=z,
            receiver=self.receiver,
            measured=measured[heard],
            predicted=predicted[heard],
            low=low[heard],
            high=high[heard],
        )

    def _keep_maps(self, predictor: SwiftWRFPredictor) -> None:
        """Predicted field and width of the interval over the floor, at the median height of the measurements."""
        position = self.train.transmitter_position
        shown = torch.cat([position, self.test.transmitter_position])
        if self.train.located:
            shown = torch.cat([shown, self.train.receiver_position])
        low, high = shown.min(dim=0).values, shown.max(dim=0).values
        cell = float((high - low)[:2].max()) / MAP_CELLS or 1.0
        xs, ys = (
            torch.arange(float(a), float(b) + cell, cell, dtype=torch.float64)
            for a, b in zip(low[:2], high[:2], strict=True)
        )
        grid = torch.stack([*torch.meshgrid(xs, ys, indexing="xy")], dim=-1).reshape(-1, 2)
        places = torch.cat([grid, position[:, 2].median().expand(len(grid), 1)], dim=1)
        middle, lower, upper = (p.T.reshape(-1, len(ys), len(xs)).numpy() for p in predictor.model.predict(places))
        maps = {
            "x": xs.numpy(),
            "y": ys.numpy(),
            "predicted": middle.astype(np.float32),
            "width": (upper - lower).astype(np.float32),
            "measured_position": self.train.transmitter_position.numpy(),
            "measured": self.train.rssi_dbm.numpy(),
            "receiver": self.train.receiver_position.numpy(),
            "receiver_names": np.array(self.train.receiver_names),
        }
        self.directory.write_npz("maps.npz", maps | self.plan)

    def overall(self) -> dict[str, PredictorMetrics]:
        """What metrics.json says of each method."""
        errors = grouped(DataFrame(self.errors), ["method"], "abs_error_db")
        return {name: {"abs_error_db": errors[name,], "seconds": self.seconds[name]} for name in self.seconds}

    def receivers(self) -> dict[str, dict[str, ReceiverMetrics]]:
        """What metrics.json says of each method at each receiver; one that no test row heard has no errors."""
        errors, none = grouped(DataFrame(self.errors), ["receiver", "method"], "abs_error_db"), error_summary([])
        return {
            receiver: {name: {"abs_error_db": errors.get((receiver, name), none)} for name in self.seconds}
            for receiver in self.test.receiver_names
        }
