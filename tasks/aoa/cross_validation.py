"""Cross-validation of turbo learning on the measured spectra: do synthetic spectra reduce the error, and how many?

Kernel ridge regression stands in for the network, because it trains in a second. Withheld spectra and test spectra take no
part. The number of synthetic positions is chosen by the errors, so the error at the chosen number is too optimistic. The
interval is therefore that of the rule: for each fold, the number is chosen on the other folds.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray

from augment import Fold, Mixed, synthetic_positions
from swiftwrf.metrics import angle_errors
from swiftwrf.runtime.threads import single_thread
from tasks.aoa.estimators import make_estimator
from tasks.metrics import AdviceMetrics, ChangeMetrics

STAND_IN = "kernel_ridge"
N_SYNTHETIC_CANDIDATES = (300, 1000, 3000)
N_SYNTHETIC_COMPARED = 1000  # number of positions at which predicted means and samples are compared
N_BOOTSTRAP = 2000


@single_thread()
def advise(folds: Sequence[Fold], n_synthetic: int, seed: int) -> AdviceMetrics:
    """Return the change of the error on held-out measured spectra by synthetic spectra of one field model.

    Args:
        folds: Field model fitted without each fold in turn, at least two folds.
        n_synthetic: Number of synthetic positions that the run adds. Larger numbers are not compared.
        seed: Seed of positions, samples and stand-in.
    """
    numbers = sorted({*(n for n in N_SYNTHETIC_CANDIDATES if n < n_synthetic), *([n_synthetic] if n_synthetic else [])})
    compared = min(N_SYNTHETIC_COMPARED, n_synthetic)
    every = range(len(folds))

    @cache
    def fold_errors(fold: int, number: int, sampled: bool) -> NDArray[np.float64]:
        return _errors(folds[fold], number, sampled, seed)

    def errors(some: Iterable[int], number: int, sampled: bool = False) -> NDArray[np.float64]:
        return np.concatenate([fold_errors(fold, number, sampled) for fold in some])

    def chosen(some: Sequence[int]) -> tuple[int, bool]:
        """Choose the number of positions, and whether to sample, by the errors of some folds."""
        means = errors(some, compared)
        # samples must be significantly better than means
        sampled = folds[0].model.samples and _change(means, errors(some, compared, True))["high"] < 0
        return min(numbers, key=lambda number: float(np.median(errors(some, number, sampled)))), sampled

    measured_only = errors(every, 0)
    advice: AdviceMetrics = {
        "stand_in": STAND_IN,
        "n_held_out": len(measured_only),
        "measured_only_deg": float(np.median(measured_only)),
        "gains": [],
        "rule": None,
        "sampled": False,
        "recommended_extra": 0,
        "helps": False,
    }
    if not numbers:
        return advice
    best, sampled = chosen(every)
    for with_samples in (False, True) if folds[0].model.samples else (False,):
        for number in numbers if with_samples == sampled else [compared]:
            change = _change(measured_only, errors(every, number, with_samples))
            advice["gains"].append({"extra": number, "sampled": with_samples, **change})
    by_rule = [fold_errors(fold, *chosen([other for other in every if other != fold])) for fold in every]
    rule = advice["rule"] = _change(measured_only, np.concatenate(by_rule))
    advice["sampled"] = sampled
    # a gain at one number of positions alone is likely chance, because few spectra are held out
    if all(gain["change"] < 0 for gain in advice["gains"] if gain["sampled"] == sampled):
        advice["recommended_extra"] = best
        advice["helps"] = rule["high"] < 0
    return advice


def _errors(fold: Fold, n_synthetic: int, sampled: bool, seed: int) -> NDArray[np.float64]:
    """Return the angular errors [deg] of the stand-in on held-out spectra, trained with synthetic spectra."""
    train = Mixed.measured(fold.train)
    if n_synthetic:
        positions = synthetic_positions(fold.train, n_synthetic, seed)
        if sampled:
            spectra = fold.model.sample(positions.position, generator=torch.Generator().manual_seed(seed))
        else:
            spectra = fold.model.synthesize(positions.position)
        train = train.add(positions, spectra.cpu())
    stand_in = make_estimator(STAND_IN, seed=seed).fit(train)
    errors = angle_errors(stand_in.predict(fold.test.spectrum), fold.test.label)["great_circle"].rad2deg()
    return cast(NDArray[np.float64], errors.double().numpy())


def _change(before: NDArray[np.float64], after: NDArray[np.float64]) -> ChangeMetrics:
    """Return the median of `after`, its relative change against that of `before`, and the change's 95 % bootstrap interval
    over held-out spectra."""
    rows = np.random.default_rng(0).integers(len(before), size=(N_BOOTSTRAP, len(before)))
    medians = np.median(after[rows], axis=1), np.median(before[rows], axis=1)
    low, high = np.percentile(medians[0] / np.maximum(medians[1], 1e-9) - 1, (2.5, 97.5))
    change = float(np.median(after) / max(float(np.median(before)), 1e-9) - 1)
    return {"median_deg": float(np.median(after)), "change": change, "low": float(low), "high": float(high)}
