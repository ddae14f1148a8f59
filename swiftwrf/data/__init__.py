"""Measurements: spectra and RSSI at known positions, their splits, their formats, and simulated rooms."""

from __future__ import annotations

from pathlib import Path

from swiftwrf.data.formats import RSSI_FORMATS, SPECTRA_FORMATS, read
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.spectra import Spectra


def load_spectra(path: str | Path) -> Spectra:
    """Reads a folder of spectra in any format of `swiftwrf.data.formats`: the NeRF2 layout (images), or ray paths.

    Raises:
        InputError: what is missing, does not fit together or is not what the layout says.
    """
    return read(path, SPECTRA_FORMATS)


def load_rssi(path: str | Path) -> Rssi:
    """Reads a folder of RSSI in any format of `swiftwrf.data.formats`: the NeRF2 layout.

    Raises:
        InputError: what is missing, does not fit together or is not what the layout says.
    """
    return read(path, RSSI_FORMATS)


__all__ = ["Rssi", "Spectra", "load_rssi", "load_spectra"]
