"""Which synthesizer suits the scene: those that apply, compared on measured spectra that they did not see."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch

from augment.synthesizers import SYNTHESIZERS, Settings, Synthesizer, lacks, make_synthesizer
from swiftwrf import FitError, InputError, Spectra
from swiftwrf.data.spectra import check_training
from swiftwrf.data.splits import folds
from swiftwrf.gp import thinned
from swiftwrf.metrics import psnr

JUDGES = 1000  # held-out spectra of a fold that are compared: more do not change the choice
SLOW = ("nerf2", "wrfgs", "vae", "dcgan", "raytrace")  # compared only where they are asked for by name


@dataclass(frozen=True)
class Trial:
    """A synthesizer fitted without some measured spectra, and those.

    What a search decides (which planes there are, how many primitives) was decided without the `out` of the first trial
    only; what is fitted (where the planes are, how they reflect) was fitted without each one's.

    Args:
        synthesizer: fitted to `kept`.
        kept, out: measured spectra that it was fitted to, and those that it was not.
    """

    synthesizer: Synthesizer
    kept: Spectra
    out: Spectra


@dataclass(frozen=True)
class Choice:
    """What was compared and what was best.

    Args:
        name: of the best.
        psnr_db: median over held-out measured spectra, of each candidate.
        seconds: that each comparison took.
        trials: the comparisons of the best, one a fold that was held out.
    """

    name: str
    psnr_db: dict[str, float]
    seconds: dict[str, float]
    trials: list[Trial]


def candidates(data: Spectra) -> list[str]:
    """Synthesizers that the data have everything for and that take seconds."""
    return [name for name in SYNTHESIZERS if name not in SLOW and not lacks(name, data)]


def choose_synthesizer(measured: Spectra, settings: Settings, names: Iterable[str] | None = None) -> Choice:
    """The synthesizer whose spectra come closest to measured ones that were held out from it, a fifth at a time.

    Those that search (for a room, say) do so once; in the other folds they go on from what was found there.

    Args:
        measured: the only spectra it sees.
        settings: of the candidates, and how spectra are held out; all are compared in their quick size.
        names: of the candidates; all that apply and are fast unless given.

    Raises:
        InputError: fewer than 10 spectra, something not finite, or no candidate that can be fitted.
    """
    check_training(measured)
    fold = folds(measured.position, settings.validation, settings.seed)
    quiet = replace(settings, checkpoint=None, on_record=None, preset="quick", progress=False)
    score: dict[str, float] = {}
    trials: dict[str, list[Trial]] = {}
    seconds: dict[str, float] = {}
    for name in names or candidates(measured):
        found, trials[name], seconds[name] = [], [], 0.0
        for number in range(int(fold.max()) + 1):
            rows = (fold == number).nonzero()[:, 0]
            kept, out = measured.subset((fold != number).nonzero()[:, 0]), measured.subset(*thinned(rows, rows=JUDGES))
            synthesizer = make_synthesizer(name, quiet)
            began = time.perf_counter()
            try:
                if trials[name]:
                    synthesizer.fit_like(trials[name][0].synthesizer, kept)
                else:
                    synthesizer.fit(kept)
                drawn = synthesizer.synthesize(out.position)
            except (InputError, FitError):  # one that cannot be fitted here is no candidate
                break
            seconds[name] += time.perf_counter() - began + synthesizer.shared_seconds
            trials[name].append(Trial(synthesizer, kept, out))
            found.append(psnr(drawn, out.spectrum))
        else:
            score[name] = float(torch.cat(found).median())
    if not score:
        raise InputError(f"no synthesizer can be fitted to {len(measured)} measured spectra of {measured.name}")
    best = max(score, key=lambda name: score[name])
    return Choice(best, score, seconds, trials[best])
