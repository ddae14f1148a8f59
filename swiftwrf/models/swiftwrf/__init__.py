"""SwiftWRF: 2D Gaussians that deform with the position, and their fit."""

from swiftwrf.models.swiftwrf.config import FitConfig, ModelConfig
from swiftwrf.models.swiftwrf.model import SwiftWRF, fit

__all__ = ["FitConfig", "ModelConfig", "SwiftWRF", "fit"]
