"""Measure how accurately each localizer locates transmitters from measured RSSI, and the time it takes.

python benchmarks/locating.py tetam-tracks:spatial tetam-tracks:block floor --folder DATA
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from record import kept, options, write_result

from swiftwrf import Rssi, load_rssi, rssi_room
from swiftwrf.locate.baselines import LOCALIZERS
from swiftwrf.locate.comparison import LocateComparison, LocateSplit, Trial

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
    found: dict[str, Any] = dict(kept(RESULT, "sets"))
    for text in config.sets:
        name, _, split = text.partition(":")
        data = read(None if name == BUILT_IN else config.folder / name).receivers(["all"])
        measured = measure(data, split or "random", config.cells, config.seed)
        found[f"{name} {split or 'random'}"] = measured
        for localizer, entry in measured["localizers"].items():
            error = entry["position_error_m"]
            print(f"{text} {localizer}: median {error['median']:.2f} m, 90 % {error['p90']:.2f} m", flush=True)
        write_result(RESULT, {"threads": torch.get_num_threads(), "sets": dict(sorted(found.items()))}, rows=[measured])


def read(source: Path | None) -> Rssi:
    """Return a data set. None is the built-in floor."""
    return rssi_room() if source is None else load_rssi(source)


def measure(data: Rssi, split: str, cells: int, seed: int) -> dict[str, Any]:
    """Return errors and seconds of every localizer on a split, and the coverage of the posterior's credible regions."""
    measured = LocateSplit.of(data, split, cells, seed)
    values = {trial: measured.fit(trial)[1] for trial in map(Trial, LOCALIZERS)}
    result = LocateComparison(measured, values)
    return {
        "n_train": len(measured.train),
        "n_test": len(measured.test),
        "n_receivers": len(measured.train.receiver_names),
        "n_undetected": measured.n_undetected,
        "seed": seed,
        "weights": values[Trial("posterior")]["weights"],
        "cells": cells,
        "localizers": result.overall,
        "coverage": {str(level): fraction for level, fraction in result.coverage.items()},
    }


if __name__ == "__main__":
    main(options(Config))
