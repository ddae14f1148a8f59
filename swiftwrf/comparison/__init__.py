"""Methods of comparison, implemented from their publications."""

from swiftwrf.comparison.base import Config
from swiftwrf.comparison.generative import Dcgan, DcganConfig, Vae, VaeConfig
from swiftwrf.comparison.nerf2 import NeRF2, NeRF2Config, NeRF2Rssi, NeRF2RssiConfig
from swiftwrf.comparison.wrfgs import WrfGs, WrfGsConfig

__all__ = ["Config", "Dcgan", "DcganConfig", "NeRF2", "NeRF2Config", "NeRF2Rssi", "NeRF2RssiConfig", "Vae"]
__all__ += ["VaeConfig", "WrfGs", "WrfGsConfig"]
