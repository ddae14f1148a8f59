"""Methods of comparison, implemented from their publications."""

from swiftwrf.comparison.base import Config, TrainedModel
from swiftwrf.comparison.dcgan import Dcgan, DcganConfig
from swiftwrf.comparison.nerf2 import NeRF2, NeRF2Config
from swiftwrf.comparison.nerf2_rssi import NeRF2Rssi, NeRF2RssiConfig
from swiftwrf.comparison.vae import Vae, VaeConfig
from swiftwrf.comparison.wrfgs import WrfGs, WrfGsConfig

__all__ = ["Config", "Dcgan", "DcganConfig", "NeRF2", "NeRF2Config", "NeRF2Rssi", "NeRF2RssiConfig", "TrainedModel"]
__all__ += ["Vae", "VaeConfig", "WrfGs", "WrfGsConfig"]
