"""Reading of several stations: a folder for each, or files that describe several arrays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from swiftwrf.data.files import read_text
from swiftwrf.data.formats.base import (
    SNAPSHOT_FORMATS,
    SPECTRA_FORMATS,
    ReadOptions,
    read_spectra,
    reader_of,
)
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.stations import MAX_DIFFERENCE_M, Stations
from swiftwrf.errors import InputError

PACKETS = "packets.txt"  # numbers of the transmissions of a station, one a row of its measurements


def station_names(path: Path, options: ReadOptions | None = None) -> list[str]:
    """Return the names of the stations in a source: of its folders with measurements, or of the arrays that it describes.

    Args:
        path: Folder or file.
        options: What the user states about the files.
    """
    options = options or ReadOptions()
    if folders := _folders(path):
        return [folder.name for folder in folders]
    reader = reader_of(path, options, SPECTRA_FORMATS, SNAPSHOT_FORMATS)
    return [] if reader is None else reader.stations(path)


def read_stations(path: Path, options: ReadOptions) -> Stations:
    """Return the spectra of all stations in a folder or file.

    Raises:
        InputError: No stations, measurements of one that cannot be read, or transmissions that cannot be joined.
    """
    if folders := _folders(path):
        spectra = _joined({folder.name: (folder, read_spectra(folder, options)) for folder in folders})
    elif names := station_names(path, options):
        numbered = enumerate(names, start=1)
        spectra = {name: read_spectra(path, replace(options, station=number)) for number, name in numbered}
    else:
        raise InputError(
            f"{path} has no stations: expected a folder of measurements for each, or a file that describes several arrays"
        )
    return Stations(spectra, name=path.resolve().name)


def _folders(path: Path) -> list[Path]:
    """Return the folders of a folder that hold measurements, if it holds none itself and there are two or more."""
    if not path.is_dir() or _holds(path):
        return []
    found = [folder for folder in sorted(path.iterdir()) if folder.is_dir() and _holds(folder)]
    return found if len(found) > 1 else []


def _holds(path: Path) -> bool:
    return reader_of(path, ReadOptions(), SPECTRA_FORMATS, SNAPSHOT_FORMATS) is not None


def _joined(found: dict[str, tuple[Path, Spectra]]) -> dict[str, Spectra]:
    """Return spectra of stations whose rows of equal index are one transmission.

    Packet numbers decide where there are some. Otherwise rows with equal numbers are one transmission if all stations have
    the same positions, else rows with equal positions.

    Raises:
        InputError: Stations with other positions and several rows at one of them.
    """
    if any((folder / PACKETS).is_file() for folder, _ in found.values()):
        return {name: spectra.derived(index=_packets(folder, spectra)) for name, (folder, spectra) in found.items()}
    spectra = {name: each for name, (_, each) in found.items()}
    first = next(iter(spectra.values()))
    if all(
        len(each) == len(first) and float((each.position - first.position).abs().max()) < MAX_DIFFERENCE_M
        for each in spectra.values()
    ):
        return spectra
    cell = torch.cat([each.position for each in spectra.values()]).div(MAX_DIFFERENCE_M).round()
    _, number = cell.unique(dim=0, return_inverse=True)
    numbers = number.split([len(each) for each in spectra.values()])
    for (name, each), index in zip(spectra.items(), numbers, strict=True):
        if len(index.unique()) < len(each):
            raise InputError(
                f"stations have other positions than {name}, which has several measurements at one; give the number of each "
                f"transmission in {PACKETS}, one a row, in the folder of each station"
            )
    return {name: each.derived(index=index) for (name, each), index in zip(spectra.items(), numbers, strict=True)}


def _packets(folder: Path, spectra: Spectra) -> Tensor:
    """Return the numbers of the transmissions of a station."""
    file = folder / PACKETS
    if not file.is_file():
        raise InputError(f"{file} is missing; other stations have one, so each needs the numbers of its transmissions")
    try:
        number = np.array(read_text(file).split(), dtype=np.int64)
    except (ValueError, OverflowError):
        raise InputError(f"{file} must hold whole numbers, one a row of the measurements") from None
    rows = spectra.index  # of a part, if a reader leaves rows out
    if len(rows) and int(rows.max()) >= len(number):
        raise InputError(f"{file} has {len(number)} numbers, but {folder} has a row {int(rows.max()) + 1}")
    return torch.from_numpy(number)[rows]
