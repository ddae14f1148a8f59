"""Measure how accurately each localizer locates transmitters from measured RSSI, and the time it takes.

python benchmarks/locating.py tetam-tracks:spatial tetam-tracks:block floor --folder DATA
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from committed import RESULTS, load
from record import write_result

from swiftwrf import Rssi, load_rssi, rssi_room
from swiftwrf.locate.baselines import LOCALIZERS
from swiftwrf.runtime.durable import strict
from tasks.locate.experiment import Results, prepared
from tasks.locate.steps import Localization

RESULT = "locating_rssi"
BUILT_IN = "floor"


@dataclass(frozen=True)
class Config:
    sets: Annotated[tuple[str, ...], tyro.conf.Positional]
    """data sets and splits, NAME or NAME:SPLIT (default split: random); floor is the built-in one. Other sets that were
    measured before are kept"""
    folder: Path = Path()
    """folder of the data sets"""
    cells: int = 4000
    """number of candidate positions of the posterior"""
    seed: int = 0


def main(config: Config) -> None:
    """Measure each data set and write `results/locating_rssi.json`."""
    found = earlier()
    for text in config.sets:
        name, _, split = text.partition(":")
        data = read(None if name == BUILT_IN else config.folder / name).receivers(["all"])
        measured = measure(data, split or "random", config.cells, config.seed)
        found[f"{name} {split or 'random'}"] = measured
        for localizer, entry in measured["localizers"].items():
            error = entry["position_error_m"]
            print(f"{text} {localizer}: median {error['median']:.2f} m, 90 % {error['p90']:.2f} m", flush=True)
        write_result(RESULT, {"threads": torch.get_num_threads(), "sets": dict(sorted(found.items()))})


def earlier() -> dict[str, Any]:
    """Return the sets that are in the results already."""
    sets: dict[str, Any] = load(RESULT)["sets"] if (RESULTS / f"{RESULT}.json").is_file() else {}
    return sets


def read(source: Path | None) -> Rssi:
    """Return a data set. None is the built-in floor."""
    return rssi_room() if source is None else load_rssi(source)


def measure(data: Rssi, split: str, cells: int, seed: int) -> dict[str, Any]:
    """Return errors and seconds of every localizer on a split, and the coverage of the posterior's credible regions."""
    experiment, n_undetected = prepared(data, split, cells, seed)
    results = Results(experiment)
    with tempfile.TemporaryDirectory() as folder:
        for name in LOCALIZERS:
            step = Localization(name)
            results.add(step, strict(step.compute(experiment, Path(folder))))
    metrics = results.metrics(data, n_undetected)
    kept = ("n_train", "n_test", "n_receivers", "n_undetected", "seed", "weights")
    content = {name: value for name, value in metrics.items() if name in kept}
    return content | {"cells": cells, "localizers": metrics["overall"], "coverage": metrics["calibration"]}


if __name__ == "__main__":
    main(tyro.cli(Config))
