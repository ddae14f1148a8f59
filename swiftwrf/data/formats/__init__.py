"""File formats: one reader a file of this folder, found by what the folder of the data holds."""

from swiftwrf.data.formats.base import RSSI_FORMATS, SPECTRA_FORMATS, Format, read

SPECTRA_FORMATS.discover(__name__, __path__)  # and with them the formats of RSSI: they lie in one folder

__all__ = ["RSSI_FORMATS", "SPECTRA_FORMATS", "Format", "read"]
