"""Compare all predictors on every measured RSSI data set: errors on the same test pairs, intervals and seconds.

`identity` is `swiftwrf` with heads whose primitives are in phase in all directions, so that they do not change the field.

python benchmarks/rssi.py --data DATA

Every predictor is fitted to the training rows of a split and predicts its test rows. The result is
written after each split, and `--resume` skips the splits that it contains.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import torch
from record import kept, options, write_result
from torch import Tensor

from swiftwrf import Rssi, load_rssi
from swiftwrf.metrics import LEVEL, method_summary, summary
from swiftwrf.models.prediction import Prediction
from swiftwrf.rssi import RssiModel
from swiftwrf.rssi.comparison import compare
from swiftwrf.rssi.head import DB_PER_UNIT, Head, render
from swiftwrf.runtime.steps import Memo

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
OWN = ("swiftwrf", IDENTITY, "pairs")  # all others are baselines
Row = dict[str, Any]


@dataclass(frozen=True)
class Config:
    data: Path
    """folder of the data sets"""
    sets: tuple[str, ...] = ()
    """data sets to measure. Defaults to all; the results of others are kept"""
    also: tuple[str, ...] = ()
    """predictors that are compared only when named, e.g. nerf2, whose fit is slow"""
    resume: bool = False
    """skip splits that the result contains"""


def main(config: Config) -> None:
    """Measure each split and write `results/rssi.json`."""
    found: dict[str, Row] = dict(kept(RESULT, "sets"))
    for name, split in splits(config.sets):
        key = f"{name} {split}"
        if config.resume and key in found:
            continue
        found[key] = measure(load_rssi(config.data / name, transmitter=TRANSMITTER.get(name, ())), split, config.also)
        found = {key: found[key] for key in (f"{name} {split}" for name, split in splits()) if key in found}
        for method, row in found[key]["methods"].items():
            error = row["abs_error_db"]
            print(f"{key} {method}: median {error['median']:.3f} dB, mean {error['mean']:.3f} dB", flush=True)
        write_result(RESULT, {"sets": found}, rows=[found[key]])


def splits(names: tuple[str, ...] = ()) -> Iterator[tuple[str, str]]:
    """Yield data set and split; those of all data sets without names."""
    for name in names or SPLITS:
        for split in SPLITS[name]:
            yield name, split


def measure(data: Rssi, split: str, also: tuple[str, ...] = ()) -> Row:
    """Return errors, differences to the best baseline, coverage of intervals and seconds of every predictor on a split."""
    result = compare(data, split=split, also=also)
    with TemporaryDirectory() as folder, patch("swiftwrf.rssi.training.render", in_phase):
        others = Memo(Path(folder))
        for name in result.values.keys() - {RssiModel.name, result.model}:
            others.keep(name, result.values[name], 0.0)
        identity = compare(data, split=split, also=also, keep=others)
    result = replace(result, values={**result.values, IDENTITY: identity.values[RssiModel.name]})
    median = {name: values["median_db"] for name, values in result.values.items()}
    best = min((name for name in median if name not in OWN), key=lambda name: median[name])
    table = method_summary(result.errors, "abs_error_db", best)
    methods: dict[str, Row] = {}
    for name, own in result.errors.groupby("method", sort=False)["abs_error_db"]:
        values, change = result.values[name], table.loc[name]
        # few test rows have no interval
        ends = {end: float(change[f"difference_{end}"]) for end in ("low", "high")}
        ends = {end: value for end, value in ends.items() if math.isfinite(value)}
        difference = {"median": median[name] - median[best], "mean": float(change["difference"]), **ends}
        seconds = {part: values[part] for part in ("fit", "predict")}
        methods[name] = {"abs_error_db": summary(own), "seconds": seconds, "difference_db": difference}
        if values["std"] is not None:
            error, std = torch.tensor(own.to_numpy()), torch.as_tensor(values["std"]).double()
            _, half_width = Prediction(torch.zeros_like(std), std).interval(LEVEL)
            methods[name]["coverage"] = float((error <= half_width).double().mean())
    return {
        "n_rows": len(data),
        "n_train": len(result.train),
        "n_test": len(result.test),
        "n_receivers": len(data.receiver_names),
        "model": result.model,
        "best_baseline": best,
        "methods": methods,
    }


def in_phase(heads: Iterable[Head]) -> Tensor:
    """Return fields of primitives that are in phase in all directions: the head is then 100 + c for c > -100 dB."""
    rendered = torch.zeros_like(render(heads := list(heads)))
    if len(heads[0].primitives):
        rendered[:, :, 0] = torch.tensor([1.0, 1 / DB_PER_UNIT])[:, None]
    return rendered


if __name__ == "__main__":
    main(options(Config))
