"""Turbo learning: measured spectra and synthesized ones at positions where none was measured, in one training set."""

from augment.mix import Mixed, Places, mix, withhold
from augment.synthesizers import SYNTHESIZERS, Settings, Synthesizer, make_synthesizer

__all__ = [
    "SYNTHESIZERS",
    "Mixed",
    "Places",
    "Settings",
    "Synthesizer",
    "make_synthesizer",
    "mix",
    "withhold",
]
