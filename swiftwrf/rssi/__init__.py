"""RSSI at fixed receivers from the position of the transmitter."""

from swiftwrf.rssi.base import Map, RssiFitContext, RssiPredictor
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.floors import FloorAttenuation, estimate_floor_attenuation
from swiftwrf.rssi.model import LEVEL, RssiModel, fit_rssi
from swiftwrf.rssi.offsets import estimate_offsets
from swiftwrf.rssi.pairs import PairConfig, PairModel, PairPredictor
from swiftwrf.rssi.path_loss import PathLoss, fit_path_loss, fit_shared_path_loss, log_distance

__all__ = [
    "LEVEL",
    "Map",
    "PairConfig",
    "PairModel",
    "PairPredictor",
    "PathLoss",
    "RssiConfig",
    "RssiFitContext",
    "RssiModel",
    "RssiPredictor",
]
__all__ += [
    "FloorAttenuation",
    "estimate_floor_attenuation",
    "estimate_offsets",
    "fit_path_loss",
    "fit_rssi",
    "fit_shared_path_loss",
    "log_distance",
]
