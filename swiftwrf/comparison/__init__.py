"""Methods that SwiftWRF is compared with, written anew from what is published about them."""

from swiftwrf.comparison.base import Config, fit
from swiftwrf.comparison.dcgan import Dcgan, DcganConfig, DcganSize
from swiftwrf.comparison.drawing import Drawing
from swiftwrf.comparison.nerf2 import NeRF2, NeRF2Config, NeRF2Size
from swiftwrf.comparison.nerf2_rssi import NeRF2Rssi, NeRF2RssiConfig, NeRF2RssiSize
from swiftwrf.comparison.vae import Vae, VaeConfig, VaeSize
from swiftwrf.comparison.wrfgs import WrfGs, WrfGsConfig, WrfGsSize

__all__ = [
    "Config",
    "Dcgan",
    "DcganConfig",
    "DcganSize",
    "Drawing",
    "NeRF2",
    "NeRF2Config",
    "NeRF2Rssi",
    "NeRF2RssiConfig",
    "NeRF2RssiSize",
    "NeRF2Size",
    "Vae",
    "VaeConfig",
    "VaeSize",
    "WrfGs",
    "WrfGsConfig",
    "WrfGsSize",
    "fit",
]
