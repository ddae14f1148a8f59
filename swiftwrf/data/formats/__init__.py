"""File formats: one reader a file of this folder, found by what the folder or file of the data holds."""

from swiftwrf.data.formats.base import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS, Format, read

SPECTRA_FORMATS.discover(__name__, __path__)  # and with them the other formats: they lie in one folder

__all__ = ["RSSI_FORMATS", "SNAPSHOT_FORMATS", "SPECTRA_FORMATS", "Format", "read"]
