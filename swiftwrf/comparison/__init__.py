"""Methods that SwiftWRF is compared with, written anew from what is published about them."""

from swiftwrf.comparison.base import Config, Drawing, fit
from swiftwrf.comparison.nerf2 import NeRF2, NeRF2Config, NeRF2Size

__all__ = ["Config", "Drawing", "NeRF2", "NeRF2Config", "NeRF2Size", "fit"]
