"""Synthesizers: spectra at any position from measured ones. Each method is one file of this folder."""

from augment.synthesizers.base import SYNTHESIZERS, Settings, Synthesizer, lacks, make_synthesizer

SYNTHESIZERS.discover(__name__, __path__)

__all__ = ["SYNTHESIZERS", "Settings", "Synthesizer", "lacks", "make_synthesizer"]
