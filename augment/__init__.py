"""Turbo learning: measured spectra and synthesized ones at positions where none was measured, in one training set."""

from augment.choose import Choice, Trial, choose_synthesizer
from augment.mix import Mixed, mix, withhold
from augment.places import Places, draw_places
from augment.synthesizers import SYNTHESIZERS, Settings, Synthesizer, lacks, make_synthesizer

__all__ = [
    "SYNTHESIZERS",
    "Choice",
    "Mixed",
    "Places",
    "Settings",
    "Synthesizer",
    "Trial",
    "choose_synthesizer",
    "draw_places",
    "lacks",
    "make_synthesizer",
    "mix",
    "withhold",
]
