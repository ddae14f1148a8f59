"""Turbo learning: measured spectra and synthesized ones at positions where none was measured, in one training set."""

from augment.mix import Mixed, Places, mix, withhold
from augment.synthesize import SYNTHESIZERS, Synthesizer, make_synthesizer

__all__ = ["SYNTHESIZERS", "Mixed", "Places", "Synthesizer", "make_synthesizer", "mix", "withhold"]
