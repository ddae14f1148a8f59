"""Compare all predictors on every measured RSSI data set: errors on the same test pairs, intervals and seconds.

`identity` is `swiftwrf` with heads whose primitives are in phase in all directions, so that they do not change the field.

python benchmarks/rssi.py --data DATA

Every predictor is fitted to the training rows of a split and predicts its test rows. Seconds are processor time. The result
is written after each split, and `--resume` skips the splits that it contains.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
import tyro
from committed import RESULTS, load
from numpy.typing import NDArray
from pandas import DataFrame
from record import write_result
from torch import Tensor

from swiftwrf import Rssi, load_rssi
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.data.rssi import PLACE
from swiftwrf.metrics import paired_difference, summary
from swiftwrf.rssi import LEVEL, PairModel, RssiModel
from swiftwrf.rssi.comparison import make_predictor
from swiftwrf.rssi.head import DB_PER_UNIT, Head, render

RESULT = "rssi"
SPLITS = {
    "kolak": ("random", "spatial", "block"),
    "tetam-tracks": ("random", "spatial", "block"),
    "tetam-fingerprints": ("random", "spatial"),
    "lora-campus": ("random", "foot"),
    "dcm-rssi": ("random", "block", "place"),
    "wifi-rooms/office": ("random", "block"),
    "wifi-rooms/lecture-theatre": ("random", "block"),
    "wifi-rooms/corridor": ("random", "block"),
}
TRANSMITTER = {"dcm-rssi": ("receiver",)}  # column with the second end of the link, where both ends move
IDENTITY = "identity"
OWN = ("swiftwrf", IDENTITY, "pairs", "blend")  # all others are baselines
Row = dict[str, Any]


@dataclass(frozen=True)
class Config:
    data: Path
    """folder of the data sets"""
    sets: tuple[str, ...] = ()
    """data sets to measure. Defaults to all; the results of others are kept"""
    also: tuple[str, ...] = ()
    """predictors that are compared only when named, e.g. blend, whose fit is slow"""
    resume: bool = False
    """skip splits that the result contains"""


def main(config: Config) -> None:
    """Measure each split and write `results/rssi.json`."""
    found: dict[str, Row] = load(RESULT)["sets"] if (RESULTS / f"{RESULT}.json").is_file() else {}
    for name, split in splits(config.sets):
        key = f"{name} {split}"
        if config.resume and key in found:
            continue
        found[key] = measure(load_rssi(config.data / name, transmitter=TRANSMITTER.get(name, ())), split, config.also)
        found = {key: found[key] for key in (f"{name} {split}" for name, split in splits()) if key in found}
        for method, row in found[key]["methods"].items():
            error = row["abs_error_db"]
            print(f"{key} {method}: median {error['median']:.3f} dB, mean {error['mean']:.3f} dB", flush=True)
        write_result(RESULT, {"sets": found})


def splits(names: tuple[str, ...] = ()) -> Iterator[tuple[str, str]]:
    """Yield data set and split; those of all data sets without names."""
    for name in names or SPLITS:
        for split in SPLITS[name]:
            yield name, split


def measure(data: Rssi, split: str, also: tuple[str, ...] = ()) -> Row:
    """Return errors, differences to the best baseline, coverage of intervals and seconds of every predictor on a split."""
    data = data.receivers(["all"])
    train, test = data.split(split)
    compared = [name for name in RSSI_PREDICTORS if RSSI_PREDICTORS[name].compared(data) or name in also]
    names = [name for name in compared if not RSSI_PREDICTORS[name].lacking(data)]
    methods, errors = {}, {}
    for name in (*names, IDENTITY):
        methods[name], errors[name] = _measured(name, train, test, split)
    row, receiver = test.detected.nonzero().T.numpy()
    pairs = DataFrame(errors | {"index": row, "receiver": receiver}).set_index(["index", "receiver"])
    median = {name: entry["abs_error_db"]["median"] for name, entry in methods.items()}
    best = min((name for name in names if name not in OWN), key=lambda name: median[name])
    for name, entry in methods.items():
        mean, low, high = paired_difference(pairs, name, best)
        # few test rows have no interval
        interval = {key: value for key, value in {"low": low, "high": high}.items() if math.isfinite(value)}
        entry["difference_db"] = {"median": median[name] - median[best], "mean": mean, **interval}
    return {
        "n_rows": len(data),
        "n_train": len(train),
        "n_test": len(test),
        "n_receivers": len(data.receiver_names),
        "model": PairModel.name if data.receiver_moves else RssiModel.name,
        "best_baseline": best,
        "methods": methods,
    }


def _measured(name: str, train: Rssi, test: Rssi, split: str) -> tuple[Row, NDArray[np.float64]]:
    """Return the entry of one predictor, and its absolute errors at the detected test pairs [dB]."""
    options = {"validation": train.validation_for(split, test), "new_places": split == PLACE}
    predictor = make_predictor(RssiModel.name if name == IDENTITY else name, **options)
    began = time.process_time()
    with patch("swiftwrf.rssi.training.render", in_phase if name == IDENTITY else render):
        predictor.fit(train)
    fitted = time.process_time()
    prediction = predictor.predict_detected(test)
    seconds = {"fit": fitted - began, "predict": time.process_time() - fitted}
    error = (prediction.mean - test.rssi_dbm)[test.detected].abs().numpy()
    entry: Row = {"abs_error_db": summary(error), "seconds": seconds}
    if prediction.std is not None:
        low, high = (end[test.detected] for end in prediction.interval(LEVEL))
        measured = test.rssi_dbm[test.detected]
        entry["coverage"] = float(((low <= measured) & (measured <= high)).double().mean())
    return entry, error


def in_phase(heads: Iterable[Head]) -> Tensor:
    """Return fields of primitives that are in phase in all directions: the head is then 100 + c for c > -100 dB."""
    rendered = torch.zeros_like(render(heads := list(heads)))
    if len(heads[0].primitives):
        rendered[:, :, 0] = torch.tensor([1.0, 1 / DB_PER_UNIT])[:, None]
    return rendered


if __name__ == "__main__":
    main(tyro.cli(Config))
