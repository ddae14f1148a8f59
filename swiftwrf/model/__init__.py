"""Primitives, how they move, and the SwiftWRF model of both."""

from swiftwrf.model.config import ModelConfig
from swiftwrf.model.swiftwrf import SwiftWRF

__all__ = ["ModelConfig", "SwiftWRF"]
