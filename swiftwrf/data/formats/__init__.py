"""Readers, one a file of this package, found by what a folder or file holds."""

from swiftwrf.data.formats.base import (
    RSSI_FORMATS,
    SNAPSHOT_FORMATS,
    SPECTRA_FORMATS,
    Format,
    ReadOptions,
    read,
    read_spectra,
)

SPECTRA_FORMATS.discover(__name__, __path__)  # and with them all other formats of this package

__all__ = ["RSSI_FORMATS", "SNAPSHOT_FORMATS", "SPECTRA_FORMATS", "Format", "ReadOptions", "read", "read_spectra"]
