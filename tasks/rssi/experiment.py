"""RSSI of a moving transmitter at fixed receivers: SwiftWRF against the predictors that practitioners use."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pandas import DataFrame

from swiftwrf import InputError, Rssi, rssi_room
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.data.coordinates import degree_columns
from swiftwrf.data.files import sha256
from swiftwrf.data.rssi import PLACE
from swiftwrf.models.prediction import Prediction
from swiftwrf.positions import distance
from swiftwrf.rssi import LEVEL, PairModel, RssiModel
from swiftwrf.rssi.baselines import make_predictor
from swiftwrf.rssi.maps import RssiMap
from tasks.claim import MODEL
from tasks.metrics import PredictorMetrics, PredictorSeconds, ReceiverMetrics, RssiMetrics
from tasks.page.floor_plan import read_pixels
from tasks.page.page import reporting
from tasks.page.records import Records
from tasks.rssi.options import RssiTaskConfig
from tasks.rssi.page import page
from tasks.rssi.page.summary import answer
from tasks.run import Row, Run, choose_device
from tasks.source import asked_offsets, measured_rssi, offset_notes, split_notes
from tasks.summarise import error_summary, grouped
from tasks.terminal import console, terminal
from tasks.workers import connected


def run(config: RssiTaskConfig, resume: Path | None = None) -> None:
    """Run the experiment and write its directory, or continue an interrupted one.

    Raises:
        InputError: A configuration that the data cannot meet or that contradicts itself.
    """
    device = choose_device("cpu" if config.device == "auto" else config.device)
    plan = _read_floor_plan(config)
    whole = _load(config)
    data = whole.receivers(config.rx)
    for note in data.notes:
        console.print(f"{data.name}: {note}")
    train, test = data.split(config.split, config.seed)
    if not bool((~test.rssi_dbm.isnan()).any()):
        raise InputError(f"split {config.split!r} of {data.name} has no test rows that detect these receivers")
    pool = pool_of(whole, train, test, config)
    notes = [*split_notes(train, test, config.split), *offset_notes(data, config), *data.notes]
    if (offsets := asked_offsets(pool, config)) is not None:
        train, pool = offsets.removed(train), offsets.removed(pool)
        notes.append(offsets.note())
        console.print(f"{data.name}: {notes[-1]}")
    label = f"rx{'_'.join(config.rx)}-s{config.seed}"
    source = data.source | ({"floor plan": sha256(Path(config.floor_plan))} if config.floor_plan else {})
    with (
        connected(config.scheduler, device) as cluster,
        Run("rssi", config.out, label, config, device, source, resume) as directory,
    ):
        options = {"pool": pool, "device": device, "parallel": cluster.map if cluster else None}
        tables = _Tables(config, train, test, plan, directory, options)
        compared = [name for name in RSSI_PREDICTORS if RSSI_PREDICTORS[name].compared(data) or name in config.also]
        left_out = {name: reason for name in compared if (reason := RSSI_PREDICTORS[name].lacking(data))}
        for reason in left_out.values():
            console.print(f"left out: {reason}")
        with terminal.progress():
            tables.add([name for name in compared if name not in left_out])
        directory.computed_on(cluster.machines if cluster else ())
        directory.write_csv("errors.csv", tables.errors)
        directory.write_csv("predictions.csv", tables.predictions)
        metrics: RssiMetrics = {
            "task": "rssi",
            "data": data.name,
            "notes": [*notes, *tables.notes()],
            "split": config.split,
            "preset": config.preset,
            "seed": config.seed,
            "n_train": len(train),
            "n_test": len(test),
            "overall": tables.overall(),
            "left_out": left_out,
            "receivers": tables.receivers(),
            "model": tables.model,
            "seconds": tables.seconds[tables.model],
            "interval": {"nominal": LEVEL, "coverage": tables.coverage},
            "chosen": {"n_primitives": tables.n_primitives, "floor_attenuation_db": tables.floor_attenuation_db},
        }
        final = directory.finish(metrics, reporting(page))
    terminal.answer(answer(Records(final)), final / "report.html")


def _load(config: RssiTaskConfig) -> Rssi:
    measured = measured_rssi(config.data, config)
    return rssi_room(seed=config.seed) if measured is None else measured


def pool_of(whole: Rssi, train: Rssi, test: Rssi, config: RssiTaskConfig) -> Rssi:
    """Return the training rows at every receiver, without those that a split by place holds out."""
    if config.split != PLACE or PLACE in whole.named_splits:
        return whole.split(config.split, config.seed)[0]
    is_held_out = test.detected.any(dim=0)
    held_out = {name for name, out in zip(test.receiver_names, is_held_out.tolist(), strict=True) if out}
    kept = torch.tensor([name not in held_out for name in whole.receiver_names])
    rows = torch.isin(whole.index, train.index)
    return replace(whole, rssi_dbm=whole.rssi_dbm.where(kept, torch.nan)).subset(rows)


def _read_floor_plan(config: RssiTaskConfig) -> dict[str, Any]:
    """Return the floor plan and its corners as maps.npz stores them, or nothing if there is no plan."""
    if config.floor_plan is None or config.floor_extent is None:
        return {}
    pixels = read_pixels(config.floor_plan, f"--floor-plan {config.floor_plan}")
    return {"plan": pixels, "plan_extent": np.array(config.floor_extent)}


def _rows(**columns: torch.Tensor | list[str]) -> list[Row]:
    """Return the rows of a table with these columns."""
    values = (c.tolist() if isinstance(c, torch.Tensor) else c for c in columns.values())
    return [dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True)]


class _Tables:
    """Fits and tests every predictor, each a step of the run's directory, and collects the tables of the run."""

    def __init__(
        self,
        config: RssiTaskConfig,
        train: Rssi,
        test: Rssi,
        plan: dict[str, Any],
        directory: Run,
        options: dict[str, Any],
    ) -> None:
        self.config, self.train, self.test, self.plan = config, train, test, plan
        self.directory, self.options = directory, options
        self.errors: list[Row] = []
        self.predictions: list[Row] = []
        self.seconds: dict[str, PredictorSeconds] = {}
        self.coverage = float("nan")
        self.n_primitives = 0
        self.floor_attenuation_db: float | None = None
        self.model = PairModel.name if train.receiver_moves else RssiModel.name
        self.detected = ~test.rssi_dbm.isnan()
        self.row, column = self.detected.nonzero(as_tuple=True)
        self.receiver = [test.receiver_names[number] for number in column.tolist()]
        self.from_receiver = distance(test.transmitter_position, test.receiver_position)
        self.offset = train.offsets.of(test)[:, None] if train.offsets else torch.zeros(1, 1, dtype=torch.float64)
        self.from_training = distance(test.transmitter_position, train.transmitter_position).min(dim=1).values

    def add(self, names: Sequence[str]) -> None:
        """Fit and test predictors."""
        terminal.expect(sum(not self.directory.holds(name) for name in names))
        for name in names:
            self._add(name)
            errors = DataFrame(self.errors[-len(self.row) :])["abs_error_db"]
            terminal.result(name, f"{errors.median():.2f} dB")

    def _add(self, name: str) -> None:

        def compute() -> Row:
            config = self.config
            options = {"validation": self.train.validation_for(config.split, self.test), "seed": config.seed}
            options["new_places"] = config.split == PLACE
            predictor = make_predictor(name, config.preset, **options)
            began = time.perf_counter()
            predictor.fit(self.train, progress=True, **self.options)
            fitted = time.perf_counter()
            prediction = predictor.predict_detected(self.test)
            result: Row = {"fit": fitted - began, "predict": time.perf_counter() - fitted}
            if isinstance(predictor, RssiModel):
                result["n_primitives"] = predictor.n_primitives
            if name == self.model:
                assert isinstance(predictor, RssiModel | PairModel)
                predictor.save(self.directory.path(MODEL))
                self._write_maps(predictor)
                result["floor_attenuation_db"] = predictor.attenuation and predictor.attenuation.db
            std = None if prediction.std is None else prediction.std[self.detected]
            return result | {"predicted": prediction.mean[self.detected], "std": std}

        value = self.directory.step(name, f"fitting {name}", compute)
        self.seconds[name] = {"fit": value["fit"], "predict": value["predict"]}
        predicted, measured = self._spread(value["predicted"]) + self.offset, self.test.rssi_dbm
        self.errors += _rows(
            method=[name] * len(self.row),
            receiver=self.receiver,
            index=self.test.index[self.row],
            measured_dbm=measured[self.detected],
            predicted_dbm=predicted[self.detected],
            abs_error_db=(predicted - measured)[self.detected].abs(),
            from_receiver_m=self.from_receiver[self.detected],
            from_training_m=self.from_training[self.row],
        )
        self.n_primitives = value.get("n_primitives", self.n_primitives)
        if name == self.model:
            self.floor_attenuation_db = value.get("floor_attenuation_db")
            self._add_predictions(Prediction(predicted, self._spread(value["std"])))

    def _spread(self, values: list[float]) -> torch.Tensor:
        """Return values of the detected test pairs as a matrix (rows, R), nan elsewhere."""
        matrix = torch.full(self.detected.shape, torch.nan, dtype=torch.float64)
        matrix[self.detected] = torch.tensor(values, dtype=torch.float64)
        return matrix

    def _add_predictions(self, prediction: Prediction) -> None:
        measured, detected = self.test.rssi_dbm, self.detected
        low, high = prediction.interval(LEVEL)
        self.coverage = float(((measured >= low) & (measured <= high))[detected].double().mean())
        x, y, z = self.test.transmitter_position[self.row].unbind(dim=1)
        values = {"measured": measured, "predicted": prediction.mean, "low": low, "high": high}
        columns = {name: value[detected].round(decimals=2) for name, value in values.items()}
        degrees = degree_columns(self.test.origin, self.test.transmitter_position[self.row].numpy())
        columns |= {name: torch.from_numpy(value) for name, value in degrees.items()}
        group = {"group": self.test.groups.subset(self.row).labels()} if self.test.groups else {}
        metres = {name: axis.round(decimals=3) for name, axis in (("x", x), ("y", y), ("z", z))}
        self.predictions += _rows(**metres, receiver=self.receiver, **group, **columns)

    def _write_maps(self, model: RssiModel | PairModel) -> None:
        """Write the prediction and the width of its interval over the floor, at the median height of the measurements."""
        height, floors = None, self.train.floors
        if floors is not None:  # the floor with most measurements, since the median may be between two
            height = floors.height_m[int(floors.number(self.train.transmitter_position).mode().values)]
        chart = RssiMap.predict(model, height=height)
        lower, upper = chart.prediction.interval(LEVEL)
        maps = {
            "x": chart.x,
            "y": chart.y,
            "predicted": chart.mean,
            "width": (upper - lower).numpy(),
            "measured_position": self.train.transmitter_position.numpy(),
            "measured": self.train.rssi_dbm.numpy(),
            "receiver": self.train.receiver_position.numpy(),
            "receiver_names": np.array(self.train.receiver_names),
        }
        if self.train.origin is not None:
            maps["origin"] = np.array(self.train.origin)
        self.directory.write_npz("maps.npz", maps | self.plan)

    def notes(self) -> list[str]:
        """Return a note on the attenuation of floors, if there are any."""
        db, floors = self.floor_attenuation_db, self.train.floors
        return [] if db is None or floors is None else [f"each of the {len(floors.names)} floors takes {db:.1f} dB"]

    def overall(self) -> dict[str, PredictorMetrics]:
        """Return the entries of each method for metrics.json."""
        errors = grouped(DataFrame(self.errors), ["method"], "abs_error_db")
        return {name: {"abs_error_db": errors[name,], "seconds": self.seconds[name]} for name in self.seconds}

    def receivers(self) -> dict[str, dict[str, ReceiverMetrics]]:
        """Return the entries of each method at each receiver for metrics.json; without errors if no test row detects it."""
        errors, none = grouped(DataFrame(self.errors), ["receiver", "method"], "abs_error_db"), error_summary([])
        return {
            receiver: {name: {"abs_error_db": errors.get((receiver, name), none)} for name in self.seconds}
            for receiver in self.test.receiver_names
        }
