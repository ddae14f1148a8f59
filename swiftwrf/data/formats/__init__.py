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

__all__ = ["RSSI_FORMATS", "SNAPSHOT_FORMATS", "SPECTRA_FORMATS", "Format", "ReadOptions", "read", "read_spectra"]
