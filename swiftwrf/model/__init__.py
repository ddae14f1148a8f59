"""Primitives, how they move, and the SwiftWRF model of both."""

from swiftwrf.model.swiftwrf import ModelConfig, SwiftWRF

__all__ = ["ModelConfig", "SwiftWRF"]
