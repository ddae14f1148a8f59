"""Compare all predictors on every measured RSSI data set, and count held-out scans where coverage is predicted.

python benchmarks/rssi.py --data DATA
python benchmarks/rssi.py coverage --data DATA
python benchmarks/rssi.py receivers --data DATA --receivers 16

`errors`: every predictor is fitted to the training rows of a split and predicts its test rows. `identity` is `swiftwrf` with
heads whose primitives are in phase in all directions, so that they do not change the field.

`coverage`: `swiftwrf` is fitted to the training rows of simulated floors and of measured sets with several receivers. The
probability that any receiver is above a threshold is compared with the test scans that pass. The correlation of errors in a
scan (default of `swiftwrf.rssi.coverage.at_least`) is the one with the lowest Brier score on a fifth of the training rows,
which the fit for it leaves out.

`receivers`: the table `coverage` of a run, at its default threshold and at the median of the strongest RSSI of the training
scans: predicted and counted shares of the test scans, by floor and receiver.

The result is written after each split, and `--resume` skips the splits that it contains.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal
from unittest.mock import patch

import torch
import tyro
from record import kept, options, write_result
from torch import Tensor

from swiftwrf import Rssi, load_rssi, rssi_room
from swiftwrf.contrib.comparison.coverage import maps_and_coverage
from swiftwrf.contrib.comparison.errors import method_summary, summary
from swiftwrf.contrib.comparison.rssi import compare
from swiftwrf.contrib.comparison.steps import Memo
from swiftwrf.metrics import LEVEL
from swiftwrf.models.prediction import Prediction
from swiftwrf.rssi import RssiModel
from swiftwrf.rssi.coverage import default_threshold, reach
from swiftwrf.rssi.head import DB_PER_UNIT, Head, render
from swiftwrf.rssi.scans import at_least

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
    "dae-2025": ("user",),
    "ts-dsi1": ("published",),
    "ts-ujib1": ("published",),
    "ts-tut2": ("published",),
    "ts-tut5": ("random",),
}
# number of the most often detected receivers that are compared, of buildings with hundreds
N_RECEIVERS = {"dae-2025": 16, "ts-dsi1": 16, "ts-ujib1": 16, "ts-tut2": 16, "ts-tut5": 20}
TRANSMITTER = {"dcm-rssi": ("receiver",)}  # column with the second end of the link, where both ends move
COVERAGE = {
    **{f"simulated-floor-{seed}": ("random",) for seed in range(10)},
    "tetam-tracks": ("random", "block"),
    "kolak": ("random", "block"),
    **{f"wifi-rooms/{room}": ("random", "block") for room in ("office", "lecture-theatre", "corridor")},
    "dae-2025": ("random", "block"),
    **{f"ts-{name}": ("random", "block") for name in ("ujib1", "dsi1", "tut2", "tut5")},
}
COVERAGE_RESULT, RECEIVERS_RESULT = "coverage_headline", "coverage_receivers"
COVERED_DBM, CERTAINTY = -75.0, 0.9
QUANTILES = (0.1, 0.3, 0.5, 0.7)  # of the strongest RSSI of the training scans, further thresholds
CORRELATIONS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5)
IDENTITY = "identity"
OWN = ("swiftwrf", IDENTITY, "pairs")  # all others are baselines
Row = dict[str, Any]


@dataclass(frozen=True)
class Config:
    data: Path
    """folder of the data sets"""
    study: tyro.conf.Positional[Literal["errors", "coverage", "receivers"]] = "errors"
    """errors of all predictors, scans where coverage is predicted, or that by floor and receiver"""
    sets: tuple[str, ...] = ()
    """data sets to measure. Defaults to all; the results of others are kept"""
    receivers: int | None = None
    """most detected receivers of a set that the studies of coverage fit. Defaults to all"""
    also: tuple[str, ...] = ()
    """predictors that are compared only when named, e.g. nerf2, whose fit is slow"""
    resume: bool = False
    """skip splits that the result contains"""


def main(config: Config) -> None:
    """Measure each split and write `results/rssi.json` or the result of a study of coverage."""
    if config.study != "errors":
        return measure_coverages(config)
    found: dict[str, Row] = dict(kept(RESULT, "sets"))
    for name, split in splits(config.sets):
        key = f"{name} {split}"
        if config.resume and key in found:
            continue
        data = load_rssi(config.data / name, transmitter=TRANSMITTER.get(name, ()))
        found[key] = measure(most_detected(data, N_RECEIVERS.get(name)), split, config.also)
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


def most_detected(data: Rssi, n_receivers: int | None) -> Rssi:
    """Return the data of the receivers that were detected most often, in their order; all of them without a number."""
    if n_receivers is None:
        return data
    count = data.detected.sum(dim=0)
    return data.columns(count.argsort(descending=True, stable=True)[:n_receivers].sort().values.tolist())


def measure(data: Rssi, split: str, also: tuple[str, ...] = ()) -> Row:
    """Return errors, differences to the best baseline, coverage of intervals and seconds of every predictor on a split."""
    result = compare(data, split=split, also=also)
    # results of the others are those of the call above
    with TemporaryDirectory() as folder, patch("swiftwrf.rssi.head.render", in_phase), patch.object(Memo, "of"):
        others = Memo(Path(folder))
        for name in result.values.keys() - {RssiModel.name, result.model}:
            others.keep(name, result.values[name], 0.0)
        identity = compare(data, split=split, also=also, keep=others)
    result = replace(result, values={**result.values, IDENTITY: identity.values[RssiModel.name]})
    median = {name: values["median"] for name, values in result.values.items()}
    best = min((name for name in median if name not in OWN), key=lambda name: median[name])
    table = method_summary(result.errors, "abs_error_db", best)
    methods: dict[str, Row] = {}
    for name, own in result.errors.groupby("method", sort=False):
        values, change = result.values[name], table.loc[name]
        # few test rows have no interval
        ends = {end: float(change[f"difference_{end}"]) for end in ("low", "high")}
        ends = {end: value for end, value in ends.items() if math.isfinite(value)}
        difference = {"median": median[name] - median[best], "mean": float(change["difference"]), **ends}
        error = summary(own["abs_error_db"], own["place"])
        methods[name] = {"abs_error_db": error, "seconds": values["seconds"], "difference_db": difference}
        if values["std"] is not None:
            away, std = torch.tensor(own["abs_error_db"].to_numpy()), torch.as_tensor(values["std"]).double()
            _, half_width = Prediction(torch.zeros_like(std), std).interval(LEVEL)
            methods[name]["coverage"] = float((away <= half_width).double().mean())
    return {
        "n_rows": len(data),
        "n_train": len(result.train),
        "n_test": len(result.test),
        "n_receivers": len(data.receiver_names),
        "model": result.model,
        "best_baseline": best,
        "methods": methods,
    }


def measure_coverages(config: Config) -> None:
    """Measure the coverage of each scene and split, and write the result."""
    measured, result = measure_coverage, COVERAGE_RESULT
    if config.study == "receivers":
        measured, result = measure_receivers, RECEIVERS_RESULT
    found: dict[str, Row] = dict(kept(result, "scenes"))
    keys = [(name, split) for name in config.sets or COVERAGE for split in COVERAGE[name]]
    for name, split in keys:
        key = f"{name} {split}"
        if config.resume and key in found:
            continue
        seed = name.removeprefix("simulated-floor-")
        data = load_rssi(config.data / name) if seed == name else rssi_room(seed=int(seed))
        found[key] = measured(data, split, config.receivers)
        for row in found[key]["rows"]:
            print(key, row, flush=True)
        print(key, {name: value for name, value in found[key].items() if name != "rows"}, flush=True)
        write_result(result, {"scenes": found}, rows=[found[key]])


def measure_coverage(data: Rssi, split: str, receivers: int | None = None) -> Row:
    """Return the predicted and the counted shares of test scans with a receiver above thresholds, by floor.

    A row has the threshold, the number of test scans, the mean `predicted` probability, the counted share `above`, the share
    with a probability of at least 0.9, `certain`, and the counted share of those, `certain_above`.
    """
    train, test = most_detected(data.receivers(["all"]), receivers).split(split)
    validation = train.validation_for(split, test)
    model, limits = RssiModel(validation=validation).fit(train), thresholds(train)
    floor = torch.zeros(len(test)).long() if test.floors is None else test.floors.number(test.transmitter_position)
    rows = []
    for number in floor.unique().tolist():
        scans = test[floor == number]
        for threshold in (COVERED_DBM, *limits):
            probability, above = (
                predicted_above(model, scans, threshold),
                (scans.rssi_dbm > threshold).any(dim=1).double(),
            )
            certain, row = probability >= CERTAINTY, {"threshold_dbm": threshold, "n": len(scans)}
            row |= {"floor": test.floors.names[number]} if test.floors else {}
            row |= {"predicted": float(probability.mean()), "above": float(above.mean())}
            row |= {"certain": float(certain.double().mean()), "n_certain": int(certain.sum())}
            rows.append(row | ({"certain_above": float(above[certain].mean())} if certain.any() else {}))
    fitted, held_out = train.split(split, seed=1) if split in ("random", "block") else train.split()
    inner = RssiModel(validation=validation).fit(fitted)
    scores = {str(correlation): brier(inner, held_out, thresholds(fitted), correlation) for correlation in CORRELATIONS}
    far = reach(model)
    return {
        "n_train": len(train),
        "n_receivers": len(train.receiver_names),
        "reach_m": far if math.isfinite(far) else None,
        "brier_by_correlation": scores,
        "rows": rows,
    }


def measure_receivers(data: Rssi, split: str, receivers: int | None = None) -> Row:
    """Return the predicted and the counted shares of test scans above thresholds, by floor and receiver."""
    data = most_detected(data.receivers(["all"]), receivers)
    train, test = data.split(split)
    model = RssiModel(validation=train.validation_for(split, test)).fit(train)
    limits = default_threshold(data)[0], thresholds(train)[QUANTILES.index(0.5)]
    table = maps_and_coverage(model, train, test, limits)[2]["coverage"].dropna(subset=["n_test"])
    names = ["floor", "receiver", "threshold_dbm", "n_test", "test_predicted", "test_above"]
    return {"n_train": len(train), "n_receivers": len(train.receiver_names), "rows": table[names].to_dict("records")}


def thresholds(train: Rssi) -> list[float]:
    """Return quantiles of the strongest RSSI of scans that a receiver detects [dBm], between whole numbers."""
    strongest = train.rssi_dbm.nan_to_num(-math.inf).amax(dim=1)
    return [float(strongest[strongest.isfinite()].quantile(q).floor()) + 0.5 for q in QUANTILES]


def predicted_above(model: RssiModel, scans: Rssi, threshold: float, **options: float) -> Tensor:
    """Return the probability that any receiver of each scan is above a threshold, (n,)."""
    found, detection = model.predict_detected(scans), model.predict_detection(scans.transmitter_position)
    assert found.std is not None
    options = {"correlation": model.scan_correlation} | options
    return at_least(1, found.mean.T, found.std.T, detection.T, threshold, **options)


def brier(model: RssiModel, scans: Rssi, limits: list[float], correlation: float) -> float:
    """Return the mean squared error of the probability that any receiver is above thresholds, by the correlation."""
    errors = [
        predicted_above(model, scans, limit, correlation=correlation) - (scans.rssi_dbm > limit).any(dim=1).double()
        for limit in limits
    ]
    return float(torch.cat(errors).square().mean())


def in_phase(heads: Iterable[Head]) -> Tensor:
    """Return fields of primitives that are in phase in all directions: the head is then 100 + c for c > -100 dB."""
    rendered = torch.zeros_like(render(heads := list(heads)))
    if len(heads[0].primitives):
        rendered[:, :, 0] = torch.tensor([1.0, 1 / DB_PER_UNIT])[:, None]
    return rendered


if __name__ == "__main__":
    main(options(Config))
