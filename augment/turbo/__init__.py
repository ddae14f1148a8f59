"""Turbo learning: few measured spectra, synthetic ones at other positions, and errors on spectra that neither saw."""

from augment.turbo.learning import TurboResult, turbo_learning

__all__ = ["TurboResult", "turbo_learning"]
