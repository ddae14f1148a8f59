"""Where was it? Posterior over the position of the moving end, from a fitted field and an observation."""

from swiftwrf.locate.posterior import Posterior
from swiftwrf.locate.region import Region

__all__ = ["Posterior", "Region"]
