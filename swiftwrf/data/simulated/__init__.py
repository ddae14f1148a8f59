"""Built-in scenes with exact geometry: spectra in a room, RSSI on an office floor."""

from swiftwrf.data.simulated.rssi import rssi_room
from swiftwrf.data.simulated.spectra import simulated_room

__all__ = ["rssi_room", "simulated_room"]
