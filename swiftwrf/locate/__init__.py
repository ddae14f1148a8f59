"""Posterior over the position of the mobile terminal, from a fitted field and an observation."""

from typing import TYPE_CHECKING

from swiftwrf.locate.matched_field import MatchedField, MatchedFieldConfig
from swiftwrf.locate.posterior import Posterior, smoothed
from swiftwrf.locate.region import Region
from swiftwrf.locate.rssi import RssiLocator
from swiftwrf.runtime.lazy import import_lazily

if TYPE_CHECKING:
    from swiftwrf.contrib.comparison.locating import LocateComparison, compare

import_lazily(__name__)  # the comparison imports scikit-learn

__all__ = ["LocateComparison", "MatchedField", "MatchedFieldConfig", "Posterior", "Region", "RssiLocator"]
__all__ += ["compare", "smoothed"]
