"""Does turbo learning help here? Cross-validation inside the measured share, before anybody measures more.

The stand-in for the network is kernel ridge regression, which trains in a second; what it gains from synthetic spectra is
what there is to gain. Nothing withheld and no test spectrum is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray

from augment import Mixed, Trial, draw_places
from swiftwrf.metrics import angle_errors
from swiftwrf.runtime.threads import single_thread
from tasks.aoa.estimators import ESTIMATORS, Settings
from tasks.metrics import AdviceMetrics, ChangeMetrics, GainMetrics

STAND_IN = "kernel_ridge"
NUMBERS, MIDDLE = (300, 1000, 3000), 1000  # of further positions that are compared
DRAWS = 2000  # of the bootstrap


@single_thread()
def advise(trials: Sequence[Trial], settings: Settings, extra: int) -> AdviceMetrics:
    """What turbo learning gains on held-out measured spectra.

    Args:
        trials: synthesizers with the measured spectra that they saw and those held out from them.
        settings: of the stand-in.
        extra: number of further positions that the run adds; larger numbers are not compared.
    """

    def errors(number: int, sampled: bool = False) -> NDArray[np.float64]:
        return np.concatenate([_errors(trial, number, sampled, settings) for trial in trials])

    def gain(number: int, sampled: bool, turbo: NDArray[np.float64]) -> GainMetrics:
        return {"extra": number, "sampled": sampled, **_paired(alone, turbo)}

    alone, gains, sampled = errors(0), [], False
    if extra:
        middle = min(MIDDLE, extra)  # where means and draws are compared
        predicted = errors(middle)
        gains.append(gain(middle, False, predicted))
        if trials[0].synthesizer.samples:
            drawn = errors(middle, sampled=True)
            gains.append(gain(middle, True, drawn))
            sampled = _paired(predicted, drawn)["high"] < 0  # draws must be better beyond doubt
        others = sorted({*(n for n in NUMBERS if n < extra), extra} - {middle})
        gains += [gain(number, sampled, errors(number, sampled)) for number in others]
    best = best_gain(gains, sampled)
    # a gain from one number of positions alone is chance, of which few held-out spectra have much
    throughout = all(gain["change"] < 0 for gain in gains if gain["sampled"] == sampled)
    return {
        "stand_in": STAND_IN,
        "n_held_out": len(alone),
        "measured_only_deg": float(np.median(alone)),
        "gains": gains,
        "sampled": sampled,
        "recommended_extra": best["extra"] if best and throughout else 0,
        "helps": bool(best and throughout and best["high"] < 0),
    }


def best_gain(gains: Sequence[GainMetrics], sampled: bool) -> GainMetrics | None:
    """The number of further positions with the lowest error, of draws or of means; None where nothing was compared."""
    taken = (gain for gain in gains if gain["sampled"] == sampled)
    return min(taken, key=lambda gain: gain["median_deg"], default=None)


def _errors(trial: Trial, extra: int, sampled: bool, settings: Settings) -> NDArray[np.float64]:
    """Great-circle errors of the stand-in on the held-out spectra [deg], trained with so many synthetic ones."""
    mixed = Mixed.measured(trial.kept)
    if extra:
        places = draw_places(trial.kept, extra, settings.seed)
        generator = torch.Generator().manual_seed(settings.seed) if sampled else None
        mixed = mixed.add(places, trial.synthesizer.synthesize(places.position, generator))
    stand_in = ESTIMATORS[STAND_IN].make(settings)
    stand_in.fit(mixed)
    errors = angle_errors(stand_in.estimate(trial.out.spectrum), trial.out.label)["great_circle"].rad2deg()
    return cast(NDArray[np.float64], errors.double().numpy())


def _paired(before: NDArray[np.float64], after: NDArray[np.float64]) -> ChangeMetrics:
    """Median of `after`, its relative change against that of `before`, and the 95 % bootstrap interval of that change over
    held-out spectra."""
    rows = np.random.default_rng(0).integers(len(before), size=(DRAWS, len(before)))
    medians = np.median(after[rows], axis=1), np.median(before[rows], axis=1)
    low, high = np.percentile(medians[0] / np.maximum(medians[1], 1e-9) - 1, (2.5, 97.5))
    change = float(np.median(after) / max(float(np.median(before)), 1e-9) - 1)
    return {"median_deg": float(np.median(after)), "change": change, "low": float(low), "high": float(high)}
