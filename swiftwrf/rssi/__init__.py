"""RSSI at fixed receivers from the position of the transmitter."""

from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.fit import Map, fit_rssi
from swiftwrf.rssi.law import Law, fit_law, log_distance
from swiftwrf.rssi.model import RssiModel
from swiftwrf.rssi.uncertainty import LEVEL

__all__ = ["LEVEL", "Law", "Map", "RssiConfig", "RssiModel", "fit_law", "fit_rssi", "log_distance"]
