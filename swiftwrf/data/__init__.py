"""Measurements: spectra and RSSI at known positions, their splits, and the built-in simulated room."""

from __future__ import annotations

from pathlib import Path

from swiftwrf.data.nerf2 import load_nerf2
from swiftwrf.data.paths import load_paths
from swiftwrf.data.rssi import Rssi, load_rssi
from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError


def load_spectra(path: str | Path) -> Spectra:
    """Reads a folder of spectra: the NeRF2 layout (images), or ray paths (`paths.npz`).

    Raises:
        InputError: what is missing, does not fit together or is not what the layout says.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(
            f"{folder} is not a folder; expected one with gateway_info.yml and spectrum/, or with paths.npz"
        )
    return load_paths(folder) if (folder / "paths.npz").is_file() else load_nerf2(folder)


__all__ = ["Rssi", "Spectra", "load_rssi", "load_spectra"]
