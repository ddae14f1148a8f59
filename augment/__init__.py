"""Turbo learning: measured spectra, and synthetic spectra at positions without a measurement, in one training set."""

from typing import TYPE_CHECKING

from swiftwrf.runtime.lazy import import_lazily

if TYPE_CHECKING:
    from augment import estimators as estimators
    from augment.choose import Fold as Fold
    from augment.choose import ModelChoice as ModelChoice
    from augment.choose import choose_model as choose_model
    from augment.mix import Mixed as Mixed
    from augment.mix import mix as mix
    from augment.mix import withhold as withhold
    from augment.positions import SyntheticPositions as SyntheticPositions
    from augment.positions import sample_positions as sample_positions
    from augment.positions import synthetic_positions as synthetic_positions
    from augment.suggest import Suggestion as Suggestion
    from augment.suggest import suggest as suggest
    from augment.turbo import TurboResult as TurboResult
    from augment.turbo import turbo_learning as turbo_learning

import_lazily(__name__)
