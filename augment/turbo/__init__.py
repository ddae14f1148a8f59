"""Turbo learning: few measured spectra, synthetic ones at other positions, and errors on spectra that neither saw."""

from augment.turbo.learning import turbo_learning
from augment.turbo.results import TurboResult

__all__ = ["TurboResult", "turbo_learning"]
