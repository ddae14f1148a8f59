"""Methods of comparison, implemented from their publications."""

from swiftwrf.contrib.published.generative import Dcgan, Vae
from swiftwrf.contrib.published.nerf2 import NeRF2, NeRF2Rssi
from swiftwrf.contrib.published.wrfgs import WrfGs

__all__ = ["Dcgan", "NeRF2", "NeRF2Rssi", "Vae", "WrfGs"]
