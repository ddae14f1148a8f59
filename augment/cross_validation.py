"""Cross-validation on the measured spectra: do synthetic spectra reduce the error, how many, and which estimator is best?

Kernel regression stands in for the network, because it trains in a second. Withheld spectra and test spectra take no
part. The number of synthetic positions is chosen by the errors, so the error at the chosen number is too optimistic. The
interval is therefore that of the rule: for each fold, the number is chosen on the other folds.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from augment import Fold, Mixed, synthetic_positions
from augment.estimators import Estimator, make_estimator
from augment.estimators.base import estimated
from swiftwrf.data.splits import places
from swiftwrf.gp import subsample
from swiftwrf.locate import MatchedField, MatchedFieldConfig
from swiftwrf.metrics import angle_errors, paired_change
from swiftwrf.models.base import synthesized
from swiftwrf.runtime.threads import parallel_map

STAND_IN = "kernel_regression"  # estimator in place of the network where many or quick trainings are needed
LOCATOR = "matched_field"  # estimator that locates the moving end by the room; it needs positions, array and fixed end
N_SYNTHETIC_CANDIDATES = (300, 1000, 3000)
MAX_LOCATED = 60  # held-out spectra of a fold that are located
FOLD_LOCATOR = MatchedFieldConfig(n_calibration=40, max_cells=100_000, spacing=0.2)  # half the time of the defaults
Errors = NDArray[np.float64]
_PREDICTING = threading.Lock()  # folds are computed side by side, but parallel loops of numba take one caller at a time


def cross_validate(
    folds: Sequence[Fold], n_synthetic: int, seed: int
) -> tuple[dict[str, Any], list[Errors], list[Errors]]:
    """Return the change of the error on held-out measured spectra by synthetic spectra of one field model.

    Args:
        folds: Field model fitted without each fold in turn, at least two folds.
        n_synthetic: Number of synthetic positions that the run adds. Larger numbers are not compared.
        seed: Seed of positions and stand-in.

    Returns:
        metrics: Values for metrics.json. `gains` has the change by every number that was compared, `rule` that by the number
            chosen on the other folds. Further positions are recommended if every number reduces the error; `helps` requires
            that the interval of `rule` excludes zero, too.
        measured_only: Angular errors [deg] on the held-out spectra of each fold, trained on measured spectra alone.
        turbo: The same with synthetic spectra, their number chosen on the other folds. Empty without extra positions.
    """
    numbers = sorted({*(n for n in N_SYNTHETIC_CANDIDATES if n < n_synthetic), *([n_synthetic] if n_synthetic else [])})
    every = range(len(folds))

    @cache
    def fold_errors(number: int) -> list[Errors]:
        return parallel_map(
            lambda fold: held_out_errors(fold, make_estimator(STAND_IN, seed=seed), number, seed), folds
        )

    def errors(some: Iterable[int], number: int) -> Errors:
        return np.concatenate([fold_errors(number)[fold] for fold in some])

    def best(some: Sequence[int]) -> int:
        """Return the number of positions with the least error on some folds."""
        return min(numbers, key=lambda number: float(np.median(errors(some, number))))

    alone = fold_errors(0)
    measured_only = np.concatenate(alone)
    place = places(torch.cat([fold.test.position for fold in folds]), 2)
    validation: dict[str, Any] = {
        "stand_in": STAND_IN,
        "n_held_out": len(measured_only),
        "measured_only_deg": float(np.median(measured_only)),
        "gains": [
            {"n_synthetic": number, **paired_change(measured_only, errors(every, number), place)} for number in numbers
        ],
        "rule": None,
        "recommended_n_synthetic": 0,
        "helps": False,
    }
    if not numbers:
        return validation, alone, []
    by_rule = [fold_errors(best([other for other in every if other != fold]))[fold] for fold in every]
    rule = validation["rule"] = paired_change(measured_only, np.concatenate(by_rule), place)
    # a gain at one number of positions alone is likely chance, because few spectra are held out
    if all(gain["change"] < 0 for gain in validation["gains"]):
        validation["recommended_n_synthetic"] = best(every)
        validation["helps"] = rule["high"] < 0
    return validation, alone, by_rule


def held_out_errors(fold: Fold, estimator: Estimator, n_synthetic: int = 0, seed: int = 0) -> Errors:
    """Return the angular errors [deg] of an estimator, trained on the spectra of a fold, on the held-out spectra.

    Args:
        fold: Training and held-out spectra, and the field model of the synthetic spectra.
        estimator: Estimator, which is trained here.
        n_synthetic: Number of synthetic spectra that are added to the measured ones.
        seed: Seed of their positions.
    """
    train = Mixed.measured(fold.train)
    if n_synthetic:
        positions = synthetic_positions(fold.train, n_synthetic, seed)
        with _PREDICTING:
            spectra = synthesized(fold.model, positions.position)
        train = train.add(positions, spectra)
    estimator.fit(train)
    return _degrees(estimated(estimator, fold.test), fold.test.label)


def located_errors(fold: Fold, seed: int) -> Errors:
    """Return the angular errors [deg] of matched-field processing on held-out spectra of a fold.

    Args:
        fold: Model with a room and its spectra. At most 60 of the held-out spectra are located.
        seed: Seed of the locator.

    Raises:
        InputError: Spectra that do not suffice, or a model without a room.
    """
    test = fold.test.subset(_located_rows(len(fold.test)))
    locator = MatchedField(FOLD_LOCATOR, seed=seed).fit(fold.train, room=fold.model)
    return _degrees(locator.predict(test), test.label)


def choose_estimator(
    errors: Mapping[str, Sequence[Errors]], located: Mapping[int, Errors | None], locator: str = LOCATOR
) -> dict[str, Any]:
    """Return name and error of the estimator with the smallest median error on held-out measured spectra, for metrics.json.

    Matched-field processing is compared on a fold of each of two searches, because its fits take seconds. It is a candidate
    only if planes were found without the spectra of each of these folds. All estimators are then compared on the spectra
    that it located.

    Args:
        errors: Angular errors [deg] on the held-out spectra of each fold, by name of the method.
        located: `located_errors` by number of the fold. Empty without a field model that has a room.
        locator: Name of matched-field processing among the methods.
    """
    compared = {name: np.concatenate(parts) for name, parts in errors.items()}
    found = {number: own for number, own in located.items() if own is not None}
    if found and len(found) == len(located):
        compared = {
            name: np.concatenate([parts[number][_located_rows(len(parts[number])).numpy()] for number in found])
            for name, parts in errors.items()
        }
        compared[locator] = np.concatenate(list(found.values()))
    held_out = {name: float(np.median(values)) for name, values in compared.items()}
    best = min(held_out, key=lambda name: held_out[name])
    return {"name": best, "held_out_deg": held_out, "n_held_out": len(compared[best])}


def _located_rows(n: int) -> Tensor:
    """Return the numbers of those of n held-out spectra that are located."""
    return subsample(torch.arange(n), rows=MAX_LOCATED)[0]


def _degrees(estimate: Tensor, label: Tensor) -> Errors:
    """Return the angular errors [deg] of directions (n, 2) [rad]."""
    return cast(Errors, angle_errors(estimate, label)["great_circle"].rad2deg().double().numpy())
