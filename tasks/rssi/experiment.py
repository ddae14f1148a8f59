"""RSSI of a moving transmitter at fixed receivers: SwiftWRF against the predictors that practitioners use."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from swiftwrf import InputError, Rssi, rssi_room
from swiftwrf.contrib.comparison.rssi import compared
from swiftwrf.data.files import sha256
from swiftwrf.metrics import LEVEL, summary
from swiftwrf.rssi import PairModel, RssiComparison, RssiModel, compare
from swiftwrf.rssi.coverage import Coverage, reach
from swiftwrf.rssi.maps import RssiMap
from swiftwrf.runtime.durable import write_npz
from tasks.configs import RssiTaskConfig
from tasks.directory import Run
from tasks.environment import choose_device
from tasks.page.maps import FloorPlan, read_pixels
from tasks.page.page import finish
from tasks.records import Row, write_table
from tasks.rssi.maps import CERTAINTY, COVERED_DBM
from tasks.rssi.page import answer, page
from tasks.source import measured_rssi, offset_notes, split_notes
from tasks.terminal import console, terminal
from tasks.workers import connected, workers_of

FEWER = (0.125, 0.25, 0.5)  # of the training rows, for the figure of the error against their number


def run(config: RssiTaskConfig, resume: Path | None = None) -> None:
    """Run the experiment and write its directory, or continue an interrupted one.

    Raises:
        InputError: A configuration that the data cannot meet or that contradicts itself.
    """
    device = choose_device("cpu" if config.device == "auto" else config.device)
    measured = measured_rssi(config.data, config.table)
    whole = rssi_room(seed=config.seed) if measured is None else measured
    data = whole.receivers(config.rx)
    plan = _read_floor_plan(config, data)
    for note in data.notes:
        console.print(f"{data.name}: {note}")
    for reason in compared(data, config.also)[1].values():
        console.print(f"left out: {reason}")
    label = f"rx{'_'.join(config.rx)}-s{config.seed}"
    source = data.source | ({"floor plan": sha256(Path(config.floor_plan))} if config.floor_plan else {})

    def described(value: Row) -> str:
        return f"{value['median_db']:.2f} dB" if "median_db" in value else ""

    with (
        connected(config.scheduler, device) as cluster,
        Run("rssi", label, config, device, source, resume, described=described) as directory,
    ):
        with workers_of(directory, cluster) as workers, terminal.progress():
            result = compare(
                whole,
                receivers=config.rx,
                split=config.split,
                seed=config.seed,
                also=config.also,
                preset=config.preset,
                not_detected=config.not_detected,
                validation=config.validation,
                reference=config.table.reference,
                fewer=FEWER,
                device=device,
                keep=directory,
                executor=workers,
                progress=True,
            )
        if result.train.offsets is not None:
            console.print(f"{data.name}: {result.train.offsets.note()}")
        if (detection := result.predictors[result.model].detection) is not None:
            console.print(f"{data.name}: {detection.note(data.receiver_names)}")
        if plan is not None:
            plan.save(directory.folder)
        finish(directory, record(result, directory.folder, offset_notes(data, config.table)), page, answer)


def _read_floor_plan(config: RssiTaskConfig, data: Rssi) -> FloorPlan | None:
    if config.floor_plan is None:
        return None
    if config.floor_extent is None and data.plan_scale is None:
        raise InputError(f"--floor-plan needs --floor-extent x0 x1 y0 y1 [m], since {data.name} is not in its pixels")
    pixels = read_pixels(config.floor_plan, f"--floor-plan {config.floor_plan}")
    height, width = (side / (data.plan_scale or 1.0) for side in pixels.shape[:2])
    return FloorPlan(pixels, config.floor_extent or (0.0, width, -height, 0.0))


def record(result: RssiComparison, folder: Path, notes: Sequence[str] = ()) -> Row:
    """Write the tables and maps of a result into a folder, and return the content of metrics.json.

    Args:
        result: Comparison.
        folder: Folder of the files.
        notes: Further sentences on the data.
    """
    train, model = result.train, result.predictors[result.model]
    assert isinstance(model, RssiModel | PairModel)
    write_table(folder / "errors.csv", result.errors.to_dict("records"))
    write_table(folder / "predictions.csv", result.predictions.to_dict("records"))
    maps, coverage = _maps(model, train)
    write_npz(folder / "maps.npz", maps)
    seconds: dict[str, Row] = {
        name: {"fit": value["fit"], "predict": value["predict"]} for name, value in result.values.items()
    }
    notes = [*split_notes(train, result.test, result.options["split"]), *notes, *train.notes]
    if train.offsets is not None:
        notes.append(train.offsets.note())
    attenuation_db = None if model.attenuation is None else model.attenuation.db
    if attenuation_db is not None and train.floors is not None:
        notes.append(f"each of the {len(train.floors.names)} floors takes {attenuation_db:.1f} dB")
    if model.detection is not None:
        notes.append(model.detection.note(train.receiver_names))
    overall, at_receiver = (
        {key: summary(own["abs_error_db"], own["place"]) for key, own in result.errors.groupby(by)}
        for by in ("method", ["receiver", "method"])
    )
    return {
        "task": "rssi",
        "data": train.name,
        "notes": notes,
        **result.options,
        "n_train": len(train),
        "n_test": len(result.test),
        "overall": {
            name: {"abs_error_db": overall[name], "seconds": seconds[name], "detection": value["detection"]}
            for name, value in result.values.items()
        },
        "left_out": result.left_out,
        "receivers": {
            receiver: {name: {"abs_error_db": at_receiver.get((receiver, name), summary([]))} for name in result.values}
            for receiver in result.test.receiver_names
        },
        "model": result.model,
        "held_out": result.values[result.model].get("held_out", {}),
        "seconds": seconds[result.model],
        "interval": {"nominal": LEVEL, "coverage": result.coverage},
        "coverage": coverage,
        "by_rows": {str(n): {str(name): mean for name, mean in row.items()} for n, row in result.by_rows.iterrows()},
        "chosen": {
            "n_primitives": max(value["n_primitives"] for value in result.values.values()),
            "floor_attenuation_db": attenuation_db,
        },
    }


def _maps(model: RssiModel | PairModel, train: Rssi) -> tuple[dict[str, Any], list[Row]]:
    """Return maps of each floor, (floors, R, H, W) or (floors, H, W), and the coverage of each floor.

    Without floors there is one map, at the median height of the measurements.
    """
    floors, limits = train.floors, (COVERED_DBM, CERTAINTY, 1)
    names, heights = (floors.names, floors.height_m) if floors else ([""], [None])
    charts = [RssiMap.predict(model, height=height) for height in heights]
    number = floors.number(train.transmitter_position) if floors else torch.zeros(len(train), dtype=torch.int64)
    detected = [RssiMap.predict(model, height=height, detected=True) for height in heights]
    coverage = [Coverage.of(each, train[number == n], limits, reach(model)) for n, each in enumerate(detected)]
    lower, upper = zip(*(chart.prediction.interval(LEVEL) for chart in charts), strict=True)
    maps = {
        "x": charts[0].x,
        "y": charts[0].y,
        "predicted": np.stack([chart.mean for chart in charts]),
        "width": (torch.stack(upper) - torch.stack(lower)).numpy(),
        "detection": np.stack([chart.detection for chart in charts]),
        "above": np.stack([found.probability for found in coverage]),
        "inside": np.stack([found.inside for found in coverage]),
        "known": np.stack([found.measured for found in coverage]),
        "measured_position": train.transmitter_position.numpy(),
        "measured": train.rssi_dbm.numpy(),
        "receiver": train.receiver_position.numpy(),
        "receiver_names": np.array(train.receiver_names),
        "floor_names": np.array(names),
        "floor_of_row": number.numpy(),
    }
    maps = maps if train.origin is None else maps | {"origin": np.array(train.origin)}
    return maps, [{"floor": name} | found.values for name, found in zip(names, coverage, strict=True)]
