"""Cross-validation on the measured spectra: do synthetic spectra reduce the error, how many, and which estimator is best?

Withheld spectra and test spectra take no part. Kernel regression stands in for the network where the number of synthetic
positions is chosen, because it trains in a second. The number is chosen by the errors, so the error at the chosen number is
too optimistic. The interval is therefore that of the rule: for each fold, the number is chosen on the other folds.

The estimator is chosen among all methods, the network included, whose trainings take long. Each is trained once without
the spectra of two folds, and all are compared on these spectra.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from augment import Fold, Mixed, synthetic_positions
from augment.estimators import make_estimator
from swiftwrf.contrib.comparison.errors import paired_change
from swiftwrf.data.splits import places
from swiftwrf.metrics import angle_errors
from swiftwrf.models.base import synthesized
from swiftwrf.runtime.threads import parallel_map

STAND_IN = "kernel_regression"  # estimator in place of the network where many or quick trainings are needed
LOCATOR = "matched_field"  # estimator that locates the moving end by the room; it needs positions, array and fixed end
BASELINE = "constant"  # estimator that a chosen one must not be behind
N_SYNTHETIC_CANDIDATES = (300, 1000, 3000)
Errors = NDArray[np.float64]
_PREDICTING = threading.Lock()  # folds are computed side by side, but parallel loops of numba take one caller at a time


def cross_validate(folds: Sequence[Fold], n_synthetic: int, seed: int) -> dict[str, Any]:
    """Return the change of the error on held-out measured spectra by synthetic spectra of one field model, for metrics.json.

    Args:
        folds: Field model fitted without each fold in turn, at least two folds.
        n_synthetic: Number of synthetic positions that the run adds. Larger numbers are not compared.
        seed: Seed of positions and stand-in.

    Returns:
        `gains` has the change by every number that was compared, `rule` that by the number chosen on the other folds.
        Further positions are recommended if every number reduces the error; `helps` requires that the interval of `rule`
        excludes zero, too.
    """
    numbers = sorted({*(n for n in N_SYNTHETIC_CANDIDATES if n < n_synthetic), *([n_synthetic] if n_synthetic else [])})
    every = range(len(folds))

    @cache
    def fold_errors(number: int) -> list[Errors]:
        return parallel_map(lambda fold: held_out_errors(fold, number, seed), folds)

    def errors(some: Iterable[int], number: int) -> Errors:
        return np.concatenate([fold_errors(number)[fold] for fold in some])

    def best(some: Sequence[int]) -> int:
        """Return the number of positions with the least error on some folds."""
        return min(numbers, key=lambda number: float(np.median(errors(some, number))))

    measured_only = errors(every, 0)
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
        return validation
    by_rule = [fold_errors(best([other for other in every if other != fold]))[fold] for fold in every]
    rule = validation["rule"] = paired_change(measured_only, np.concatenate(by_rule), place)
    # a gain at one number of positions alone is likely chance, because few spectra are held out
    if all(gain["change"] < 0 for gain in validation["gains"]):
        validation["recommended_n_synthetic"] = best(every)
        validation["helps"] = rule["high"] < 0
    return validation


def held_out_errors(fold: Fold, n_synthetic: int, seed: int) -> Errors:
    """Return the angular errors [deg] of the stand-in, trained on the spectra of a fold, on the held-out spectra.

    Args:
        fold: Training and held-out spectra, and the field model of the synthetic spectra.
        n_synthetic: Number of synthetic spectra that are added to the measured ones.
        seed: Seed of their positions and of the stand-in.
    """
    train = Mixed.measured(fold.train)
    if n_synthetic:
        positions = synthetic_positions(fold.train, n_synthetic, seed)
        with _PREDICTING:
            spectra = synthesized(fold.model, positions.position)
        train = train.add(positions, spectra)
    return degrees(make_estimator(STAND_IN, seed=seed).fit(train).estimate(fold.test), fold.test.label)


def choose_estimator(errors: Mapping[str, Errors], place: ArrayLike | None = None) -> dict[str, Any]:
    """Return the method with the smallest error on held-out measured spectra, for metrics.json.

    The median decides. Among the methods whose median equals the smallest one up to chance (95 % interval of a paired
    bootstrap) the mean decides, which contains the large errors. A method whose median is larger than that of the mean
    direction is not chosen.

    Args:
        errors: Angular errors (n,) [deg] on the same held-out spectra, by name of the method. nan, a spectrum without an
            estimate, counts as 180 degrees.
        place: Place of each spectrum, (n,). Defaults to one place each.

    Returns:
        `name` of the chosen method, median `held_out_deg` and mean `held_out_mean_deg` of each method, and the number
        `n_held_out` of spectra.

    Example:
        >>> skewed = np.array([1.0] * 18 + [90.0] * 2)
        >>> choice = choose_estimator({"skewed": skewed, "even": np.full(20, 3.0)})
        >>> choice["name"], choice["held_out_deg"]
        ('skewed', {'skewed': 1.0, 'even': 3.0})
    """
    compared = {name: np.nan_to_num(values, nan=180.0) for name, values in errors.items()}
    median, mean = ({name: float(of(x)) for name, x in compared.items()} for of in (np.median, np.mean))
    best = min(median, key=lambda name: median[name])

    def is_equal(name: str) -> bool:
        return name == best or paired_change(compared[best], compared[name], place)["low"] <= 0

    usable = [name for name in compared if median[name] <= median.get(BASELINE, math.inf)]
    chosen = next(name for name in sorted(usable, key=lambda name: mean[name]) if is_equal(name))
    n = len(compared[chosen])
    return {"name": chosen, "held_out_deg": median, "held_out_mean_deg": mean, "n_held_out": n}


def degrees(estimate: Tensor, label: Tensor) -> Errors:
    """Return the angular errors [deg] of directions (n, 2) [rad]."""
    return cast(Errors, angle_errors(estimate, label)["great_circle"].rad2deg().double().numpy())
