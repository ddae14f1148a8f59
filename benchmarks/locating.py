"""Measure how accurately each localizer locates transmitters from measured RSSI, and the time it takes.

python benchmarks/locating.py tetam-tracks:spatial ts-tut5:published floor
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from record import kept, options, write_result

from swiftwrf import Rssi, load_rssi, rssi_room
from swiftwrf.contrib.comparison.localizers import LOCALIZERS
from swiftwrf.contrib.comparison.locating import LocateComparison
from swiftwrf.contrib.datasets import DATA_SETS, fetch

RESULT = "locating_rssi"
BUILT_IN = "floor"


@dataclass(frozen=True)
class Config:
    sets: Annotated[tuple[str, ...], tyro.conf.Positional]
    """public data sets or folders and splits, NAME or NAME:SPLIT (default split: random); floor is the built-in one.
    Other sets that were measured before are kept"""
    localizers: tuple[str, ...] = tuple(LOCALIZERS)
    """localizers that are compared"""
    cells: int = 4000
    """number of candidate positions of the posterior"""
    seed: int = 0


def main(config: Config) -> None:
    """Measure each data set and write `results/locating_rssi.json`."""
    found: dict[str, Any] = dict(kept(RESULT, "sets"))
    for text in config.sets:
        name, _, split = text.partition(":")
        measured = measure(read(name), split or "random", config)
        found[f"{name} {split or 'random'}"] = measured
        for localizer, entry in measured["localizers"].items():
            error = entry["position_error_m"]
            print(f"{text} {localizer}: median {error['median']:.2f} m, mean {error['mean']:.2f} m", flush=True)
        write_result(RESULT, {"threads": torch.get_num_threads(), "sets": dict(sorted(found.items()))}, rows=[measured])


def read(name: str) -> Rssi:
    """Return a data set: the built-in floor, that of a folder or a public one."""
    if name == BUILT_IN:
        return rssi_room()
    is_public = name in DATA_SETS and not Path(name).is_dir()
    return load_rssi(fetch(name) if is_public else Path(name))


def measure(data: Rssi, split: str, config: Config) -> dict[str, Any]:
    """Return errors and seconds of the localizers on a split, and the coverage of the posterior's credible regions.

    The benchmark's nearest neighbour has all receivers, the others those that detected at least 10 rows.
    """
    measured = LocateComparison.of(data.receivers(["all"]), split, config.cells, config.seed)
    whole = LocateComparison.of(data, split, config.cells, config.seed)
    values = {name: (whole if name == "nearest" else measured).fit(None, name) for name in config.localizers}
    result = replace(measured, values=values)
    return {
        "n_train": len(measured.train),
        "n_test": len(measured.test),
        "n_receivers": len(measured.train.receiver_names),
        "n_undetected": measured.n_undetected,
        "seed": config.seed,
        "weights": values["posterior"]["weights"],
        "cells": config.cells,
        "localizers": result.overall,
        "coverage": {str(level): fraction for level, fraction in result.coverage.items()},
    }


if __name__ == "__main__":
    main(options(Config))
