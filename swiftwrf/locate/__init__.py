"""Posterior over the position of the mobile terminal, from a fitted field and an observation."""

from swiftwrf.locate.matched_field import MatchedField, MatchedFieldConfig
from swiftwrf.locate.posterior import Posterior
from swiftwrf.locate.region import Region
from swiftwrf.locate.rssi import RssiLocator, RssiLocatorConfig
from swiftwrf.locate.track import smoothed

__all__ = ["MatchedField", "MatchedFieldConfig", "Posterior", "Region", "RssiLocator", "RssiLocatorConfig", "smoothed"]
