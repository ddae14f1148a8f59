"""Readers, one a file of this package and of `swiftwrf.contrib.formats`, found by what a folder or file holds."""

from swiftwrf.data.formats.base import (
    RSSI_FORMATS,
    SNAPSHOT_FORMATS,
    SPECTRA_FORMATS,
    Format,
    ReadOptions,
    read,
    read_spectra,
)

SPECTRA_FORMATS.discover(__name__, "swiftwrf.contrib.formats")  # and with them the formats of all kinds

__all__ = ["RSSI_FORMATS", "SNAPSHOT_FORMATS", "SPECTRA_FORMATS", "Format", "ReadOptions", "read", "read_spectra"]
