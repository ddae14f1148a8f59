"""Compare field models and estimators of directions on measured spectra, places held out in turn.

python benchmarks/measured_spectra.py --data /data

Measurements closer than 10 cm are one place, so repeats of a path are not divided between training and test. The published
splits of s23-200 are kept. Every spectrum of the other sets is a test spectrum once, predicted from the other places.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from committed import load
from record import RESULTS, write_result
from scipy.cluster.hierarchy import fclusterdata
from sklearn.model_selection import GroupKFold
from synthesis import load as load_scene
from torch import Tensor

from augment import Mixed
from augment.estimators import make_estimator
from augment.turbo.condition import NETWORKS
from swiftwrf import Spectra, make_model
from swiftwrf.data.splits import validation_for
from swiftwrf.metrics import angle_errors, covered, psnr, ssim, summary
from swiftwrf.models import FIELD_MODELS

MODELS = ("nearest", "idw", "gp", "coarray", "swiftwrf")
ESTIMATORS = ("peak", "constant", "nearest_spectrum", "kernel_regression", NETWORKS["quick"])
PUBLISHED = {"s23-200": ("random", "block")}  # splits of sets that come with more than one
WSR = tuple(f"wsr-{sight}-a-tx{number}" for sight in ("los", "nlos") for number in (2, 3, 4))
PLACE_M = 0.1  # largest distance between repeats of a place
FOLDS = 5
Row = dict[str, Any]


@dataclass(frozen=True)
class Config:
    data: Path
    """folder of the data sets"""
    sets: tuple[str, ...] = (*PUBLISHED, *WSR)
    """data sets to measure"""
    seed: int = 0
    """seed of the models and networks"""


def main(config: Config) -> None:
    """Measure every set that `results/measured_spectra.json` does not contain, and write it after each."""
    rows: list[Row] = load("measured_spectra")["sets"] if (RESULTS / "measured_spectra.json").is_file() else []
    for name in config.sets:
        for split in PUBLISHED.get(name, ("places",)):
            if any((row["set"], row["split"]) == (name, split) for row in rows):
                continue
            data = load_scene(config.data / name)
            row = {"set": name, "split": split, "moving": data.moving} | measure(data, split, config.seed)
            print(name, split, {key: round(entry["median"], 2) for key, entry in row["angle_deg"].items()}, flush=True)
            rows.append(row)
            write_result("measured_spectra", {"seed": config.seed, "sets": rows})


def parts(data: Spectra, split: str, seed: int) -> Iterator[tuple[Spectra, Spectra]]:
    """Yield training and test spectra: of the published split, or of each fold of the places."""
    if split != "places":
        yield data.split(split, seed)
        return
    place = fclusterdata(data.position.double().numpy(), PLACE_M, "distance")
    for train, test in GroupKFold(FOLDS).split(place, groups=place):
        yield data.subset(torch.from_numpy(train)), data.subset(torch.from_numpy(test))


def measure(data: Spectra, split: str, seed: int) -> Row:
    """Return the scores of all field models and estimators over the test spectra of all parts."""
    scores: dict[str, list[Row]] = {}
    errors: dict[str, list[Tensor]] = {}
    seconds: dict[str, float] = {}
    n_test = 0
    for train, test in parts(data, split, seed):
        n_test += len(test)
        for name, predicted, std in predictions(train, test, split, seed, seconds):
            entry = {"psnr_db": psnr(predicted, test.spectrum), "ssim": ssim(predicted, test.spectrum)}
            if std is not None:
                entry["covered_by_80"] = covered(predicted, std, test.spectrum)
            scores.setdefault(name, []).append(entry)
        for name in ESTIMATORS:
            began = time.process_time()
            estimator = make_estimator(name, len(train), seed=seed)
            estimator.fit(Mixed.measured(train))
            error = angle_errors(estimator.estimate(test), test.label)["great_circle"].rad2deg()
            seconds[name] = seconds.get(name, 0.0) + time.process_time() - began
            errors.setdefault(name, []).append(error)
    return {
        "n": len(data),
        "n_test": n_test,
        "grid": data.grid.shape,
        "models": {name: combined(entries) for name, entries in scores.items()},
        "angle_deg": {name: summary(torch.cat(some)) for name, some in errors.items()},
        "seconds": seconds,
    }


def predictions(
    train: Spectra, test: Spectra, split: str, seed: int, seconds: dict[str, float]
) -> Iterator[tuple[str, Tensor, Tensor | None]]:
    """Yield the name, predicted spectra and standard deviations of the mean spectrum and of each field model."""
    yield "mean", train.spectrum.mean(dim=0).expand_as(test.spectrum), None
    for name in MODELS:
        if FIELD_MODELS[name].lacking(train):  # the array of a synthetic aperture is another one for each spectrum
            continue
        began = time.process_time()
        validation = "random" if split == "places" else validation_for(split)
        model = make_model(name, validation=validation, seed=seed).fit(train)
        prediction = model.predict(test.position)
        seconds[name] = seconds.get(name, 0.0) + time.process_time() - began
        yield name, model.synthesize(test.position), prediction.std


def combined(entries: list[Row]) -> Row:
    """Return the summaries of scores over the parts, and the fraction of pixels inside 80 % intervals."""
    row: Row = {score: summary(torch.cat([entry[score] for entry in entries])) for score in ("psnr_db", "ssim")}
    if "covered_by_80" in entries[0]:
        row["covered_by_80"] = float(torch.cat([entry["covered_by_80"] for entry in entries]).mean())
    return row


if __name__ == "__main__":
    main(tyro.cli(Config))
