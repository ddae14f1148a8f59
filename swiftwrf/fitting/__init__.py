"""From measured spectra to a model: how much the scene needs, then one fit of that size."""

from swiftwrf.fitting.config import FitConfig
from swiftwrf.fitting.fit import fit

__all__ = ["FitConfig", "fit"]
