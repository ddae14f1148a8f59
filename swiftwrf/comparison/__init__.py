"""Methods of comparison, implemented from their publications."""

from swiftwrf.comparison.generative import Dcgan, Vae
from swiftwrf.comparison.nerf2 import NeRF2, NeRF2Rssi
from swiftwrf.comparison.wrfgs import WrfGs

__all__ = ["Dcgan", "NeRF2", "NeRF2Rssi", "Vae", "WrfGs"]
