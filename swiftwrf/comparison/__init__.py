"""Methods of comparison, implemented from their publications."""

from swiftwrf.comparison.base import Config, TrainedModel
from swiftwrf.comparison.dcgan import Dcgan, DcganConfig, DcganSize
from swiftwrf.comparison.nerf2 import NeRF2, NeRF2Config, NeRF2Size
from swiftwrf.comparison.nerf2_rssi import NeRF2Rssi, NeRF2RssiConfig, NeRF2RssiSize
from swiftwrf.comparison.vae import Vae, VaeConfig, VaeSize
from swiftwrf.comparison.wrfgs import WrfGs, WrfGsConfig, WrfGsSize

__all__ = [
    "Config",
    "Dcgan",
    "DcganConfig",
    "DcganSize",
    "NeRF2",
    "NeRF2Config",
    "NeRF2Rssi",
    "NeRF2RssiConfig",
    "NeRF2RssiSize",
    "NeRF2Size",
    "TrainedModel",
    "Vae",
    "VaeConfig",
    "VaeSize",
    "WrfGs",
    "WrfGsConfig",
    "WrfGsSize",
]
