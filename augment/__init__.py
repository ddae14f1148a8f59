"""Turbo learning: measured spectra, and synthetic spectra at positions without a measurement, in one training set."""

from typing import TYPE_CHECKING

from swiftwrf.runtime.lazy import import_lazily

if TYPE_CHECKING:
    from augment import estimators as estimators
    from augment.choose import Fold, ModelChoice, choose_model
    from augment.mix import Mixed, mix, withhold
    from augment.positions import SyntheticPositions, sample_positions, synthetic_positions
    from augment.suggest import Suggestion, suggest
    from augment.turbo import TurboResult, turbo_learning

import_lazily(
    __name__,
    {
        "augment": ("estimators",),
        "augment.choose": ("Fold", "ModelChoice", "choose_model"),
        "augment.mix": ("Mixed", "mix", "withhold"),
        "augment.positions": ("SyntheticPositions", "sample_positions", "synthetic_positions"),
        "augment.suggest": ("Suggestion", "suggest"),
        "augment.turbo": ("TurboResult", "turbo_learning"),
    },
)

__all__ = [
    "Fold",
    "Mixed",
    "ModelChoice",
    "Suggestion",
    "SyntheticPositions",
    "TurboResult",
    "choose_model",
    "mix",
    "sample_positions",
    "suggest",
    "synthetic_positions",
    "turbo_learning",
    "withhold",
]
