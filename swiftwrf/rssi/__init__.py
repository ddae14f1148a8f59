"""RSSI at fixed receivers from the position of the transmitter."""

from typing import TYPE_CHECKING

from swiftwrf.rssi.base import Map, RssiPredictor
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.model import RssiModel, fit_rssi
from swiftwrf.rssi.offsets import FloorAttenuation, estimate_floor_attenuation, estimate_offsets
from swiftwrf.rssi.pairs import PairModel
from swiftwrf.rssi.paper import RssiPaperModel
from swiftwrf.rssi.path_loss import PathLoss, fit_path_loss, log_distance
from swiftwrf.runtime.lazy import import_lazily

if TYPE_CHECKING:
    from swiftwrf.contrib.comparison.rssi import RssiComparison, compare
    from swiftwrf.contrib.survey.receivers import ReceiverPositions, locate_receivers

import_lazily(__name__)

__all__ = ["FloorAttenuation", "Map", "PairModel", "PathLoss", "ReceiverPositions", "RssiComparison", "RssiConfig"]
__all__ += ["RssiModel", "RssiPaperModel", "RssiPredictor", "compare", "estimate_floor_attenuation"]
__all__ += ["estimate_offsets", "fit_path_loss", "fit_rssi", "locate_receivers", "log_distance"]
