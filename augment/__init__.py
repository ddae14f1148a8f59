"""Turbo learning: measured spectra, and synthetic spectra at positions without a measurement, in one training set."""

from swiftwrf.runtime.lazy import lazy_imports

with lazy_imports(globals()):
    from augment.choose import Fold, ModelChoice, choose_model
    from augment.mix import Mixed, mix, withhold
    from augment.positions import SyntheticPositions, sample_positions, synthetic_positions
    from augment.suggest import Suggestion, suggest

__all__ = [
    "Fold",
    "Mixed",
    "ModelChoice",
    "Suggestion",
    "SyntheticPositions",
    "choose_model",
    "mix",
    "sample_positions",
    "suggest",
    "synthetic_positions",
    "withhold",
]
