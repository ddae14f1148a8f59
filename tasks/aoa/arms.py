"""The arms of the experiment: the baselines, and one network trained on measured and on synthetic spectra.

Names, meanings and colours come from the registries of estimators and synthesizers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from augment import SYNTHESIZERS
from tasks.aoa.estimators import ESTIMATORS
from tasks.page.palette import Palette

NETWORK = "aann"  # of the estimators: the one that is trained in the arms that are no baselines
TURBO = "turbo_"  # before the name of the synthesizer


@dataclass(frozen=True)
class Bound:
    """What turbo learning is compared with: the network without synthetic spectra."""

    name: str
    meaning: str
    colour: str


LOWER = Bound("measured_only", "lower bound: the network trained on the measured share alone", "#ee6677")
UPPER = Bound("measured_all", "upper bound: the network trained on all training spectra, measured", "#228833")


def baselines() -> list[str]:
    """Names of the estimators that the network must beat."""
    return [name for name in ESTIMATORS if name != NETWORK]


def turbo(synthesizer: str) -> str:
    """Name of the arm with spectra of this synthesizer."""
    return TURBO + synthesizer


def meaning() -> str:
    """All arms in words."""
    texts = [f"{bound.name}: {bound.meaning}" for bound in (LOWER, UPPER)]
    texts += [f"{name}: {ESTIMATORS[name].meaning}" for name in baselines()]
    return (
        "; ".join(texts)
        + f". {TURBO}NAME: the network trained on the measured share and on spectra that NAME synthesized at the others."
    )


def synthesizers(names: Iterable[str]) -> str:
    """These synthesizers in words; runs may hold some that are registered no more."""
    return "; ".join(f"{name}: {SYNTHESIZERS[name].meaning}" for name in names if name in SYNTHESIZERS) + "."


def palette() -> Palette:
    """Of synthesizers and arms; a turbo arm looks like its synthesizer."""
    drawn = Palette.of(SYNTHESIZERS.entries()).colours
    colours = {bound.name: bound.colour for bound in (LOWER, UPPER)}
    colours |= Palette.of(ESTIMATORS.entries()).colours
    colours |= drawn
    colours |= {turbo(name): colour for name, colour in drawn.items()}
    return Palette(colours, frozenset(baselines()))
