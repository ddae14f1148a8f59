"""Readers of the NeRF2 layout, which is the toolkit's own: `swiftwrf.data.writing` writes it.

Spectra:

| file | content |
|---|---|
| `gateway_info.yml` | `position` [m], `orientation` (x, y, z, w); optional `frequency_hz`, `element_position` [m] |
| `tx_pos.csv` or `rx_pos.csv` | header `x,y,z`: positions of the end that moves |
| `spectrum/00001.png`, ... | 8-bit grey; row 0 the lowest elevation (90/H degrees), column 0 azimuth 0 |
| `spectrum.npy` | alternative: floating point (n, elevations, azimuths) in [0, 1], or unsigned integers |
| `spectrum.npz` | alternative: `spectrum`; optional `line_of_sight`, `label`, `channel`, `frequency_hz` as of `Spectra` |

RSSI, in a table with positions of the same rows:

| file | content |
|---|---|
| `gateway_rssi.csv` | a column a receiver, named in the header [dBm]; -100 stands for not detected |
| `tx_pos.csv` or `rx_pos.csv` | header `x,y,z`: positions of the end that moves |
| `gateway_position.yml` | optional: `NAME: [x, y, z]` of receivers with known positions |
| `meta.csv` | optional: a row a measurement, with its session (`session`, `run` or `walk`), `time` [s] and `group` |
| `survey.yml` | optional: `origin: [latitude, longitude]`, `floors: {NAME: height}` [m], `receiver_moves: true`, ... |

The BLE data of the NeRF2 paper are read unchanged: `rssi.csv`, `beacon_pos.csv` and `gateway_pos.csv`.
"""

from __future__ import annotations

import hashlib
import io
import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from swiftwrf.choices import Moving
from swiftwrf.data.archives import array_header, read_arrays, read_rows, refusing_broken
from swiftwrf.data.cells import column_of_numbers, seconds, text_of
from swiftwrf.data.columns import column_of
from swiftwrf.data.coordinates import Floors, GeodeticOrigin, PlanFrame, without_fix
from swiftwrf.data.files import digests, number, numbers, read_bytes, read_table, read_xyz, read_yaml, sha256
from swiftwrf.data.formats.array_description import array_of, described_arrays, pose_of
from swiftwrf.data.formats.base import Format, ReadOptions
from swiftwrf.data.powers import NOT_DETECTED_DBM, find_fillers, without_fillers
from swiftwrf.data.receivers import read_receivers
from swiftwrf.data.rssi import META, SURVEY, Offsets, Rssi
from swiftwrf.data.spectra import OF_SPECTRA, Spectra, check_pixels
from swiftwrf.data.splits import kept_splits, read_splits
from swiftwrf.data.store import BATCH_PIXELS, Store, stored
from swiftwrf.errors import InputError, listed
from swiftwrf.positions import check_positions

TABLES = ("gateway_rssi.csv", "rssi.csv")
POSITIONS = ("tx_pos.csv", "rx_pos.csv", "beacon_pos.csv")
RECEIVERS = ("gateway_position.yml", "gateway_pos.csv")
# in survey.yml
PROPERTIES = ("origin", "floors", "receiver_moves", "groups", "offsets", "labels", "bands", "plan_scale", "margin_db")
FILES = ("gateway_rssi.csv", *POSITIONS, *RECEIVERS)  # any of which marks the layout


class Nerf2(Format[Spectra]):
    """Images or an array; row i of the positions belongs to the image numbered i from 1, or to row i of the array."""

    takes = frozenset({"array"})

    def recognises(self, path: Path) -> bool:
        return (path / "gateway_info.yml").is_file() or (path / "spectrum").is_dir()

    def read(self, path: Path, options: ReadOptions) -> Spectra:
        described = path / "gateway_info.yml"
        gateways: list[dict[str, Any]] = [value for value in read_yaml(described).values() if isinstance(value, dict)]
        if len(gateways) != 1:
            raise InputError(
                f"{described} must describe one gateway with its position and orientation, got {len(gateways)}"
            )
        names = {"position": "array_position", "orientation": "array_orientation"}
        arrays = described_arrays(described, {names.get(name, name): value for name, value in gateways[0].items()})
        needed = [*names.values(), *(("frequency_hz", "element_position") if len(arrays) > len(names) else ())]
        if missing := [name for name in needed if name not in arrays]:
            raise InputError(f"{described} lacks {', '.join(missing).replace('array_', '')} of the gateway")
        pose, array = pose_of(described, arrays), array_of(described, arrays) if "frequency_hz" in arrays else None
        if options.array is not None and array is not None and array != options.array:
            raise InputError(f"{described} describes another array than was given; leave one of them out")
        tables = [file for file in (path / "tx_pos.csv", path / "rx_pos.csv") if file.is_file()]
        if len(tables) != 1:
            raise InputError(
                f"{path} must hold one of tx_pos.csv (moving transmitter) and rx_pos.csv (moving receiver)"
            )
        moving: Moving = "transmitter" if tables[0].name == "tx_pos.csv" else "receiver"
        position = check_positions(read_xyz(tables[0]), f"positions of {tables[0]}")
        store, others, read = _read_spectra(path, len(position))
        return Spectra(
            store=store,
            position=position,
            array=array or options.array,
            moving=moving,
            name=path.resolve().name,
            fixed_position=pose.position,
            rotation=pose.rotation,
            named_splits=read_splits(path, len(position), first=1),
            source=digests([described, tables[0]], path) | read,
            **others,
        )


def _read_spectra(folder: Path, n: int) -> tuple[Store, dict[str, Any], dict[str, str]]:
    """Return spectra (n, H, W) in [0, 1], further arrays of `Spectra` by name, and digests of the files."""
    arrays = [file for file in (folder / "spectrum.npy", folder / "spectrum.npz") if file.is_file()]
    if len(arrays) + (folder / "spectrum").is_dir() > 1:
        raise InputError(f"{folder} holds spectra twice; keep one of spectrum/, spectrum.npy and spectrum.npz")
    if not arrays:
        spectrum, digest = _read_images(folder / "spectrum", n)
        return spectrum, {}, {"spectrum/*.png": digest}
    file, digest = arrays[0], sha256(arrays[0])
    others: dict[str, Any] = read_arrays(file, (), OF_SPECTRA) if file.suffix == ".npz" else {}
    return _read_values(file, n, digest), others, {file.name: digest}


def _read_values(file: Path, n: int, digest: str) -> Store:
    """Return the spectra of an array: magnitudes in [0, 1], or bytes as in images."""
    shape, kind = array_header(file, "spectrum")
    if len(shape) != 3 or shape[0] != n or min(n, shape[2]) < 2 or kind.kind not in "fu":
        raise InputError(
            f"{file}: expected spectra of shape ({n}, elevations, azimuths) for {n} positions, got {kind} of shape {shape}"
        )
    if shape[1] > shape[2]:
        raise InputError(
            f"{file}: spectra have {shape[1]} elevations and {shape[2]} azimuths; these look swapped, so give "
            "spectrum.transpose(0, 2, 1)"
        )
    check_pixels(str(file), n, shape[1:])
    kept = {1: torch.uint8, 2: torch.float16}.get(kind.itemsize, torch.float32)
    if kind.kind == "u" and kept == torch.float16:
        kept = torch.float32  # 16 bits in full
    rows = max(1, BATCH_PIXELS // math.prod(shape[1:]))

    def batches() -> Iterator[Tensor]:
        return (_checked(file, values, kept) for values in read_rows(file, "spectrum", rows))

    return stored(shape, kept, lambda: digest, batches)


def _checked(file: Path, values: NDArray[Any], kept: torch.dtype) -> Tensor:
    """Return some spectra of an array in the type of the store."""
    if kept == torch.uint8:
        return torch.from_numpy(values.copy())
    if values.dtype.kind == "u":
        values = values / np.float32(np.iinfo(values.dtype).max)
    low, high = float(values.min()), float(values.max())
    if not (low >= 0 and high <= 1 + 1e-6):  # nan compares false, so it is refused
        raise InputError(
            f"{file}: spectra are magnitudes in [0, 1], got {low:.4g} to {high:.4g}; convert decibels to magnitudes and "
            "divide by the largest"
        )
    native = values.astype(np.float16 if kept == torch.float16 else np.float32)
    return torch.from_numpy(native).clamp(0, 1)


def _read_images(folder: Path, n: int) -> tuple[Store, str]:
    """Return `00001.png` to `n`.png as (n, H, W), all grey and of one shape, and the digest of all files."""
    if not folder.is_dir():
        raise InputError(f"{folder} is missing; expected one grey image a position, 00001.png to {n:05d}.png")
    n_images = len(list(folder.glob("*.png")))
    if n_images != n:
        raise InputError(
            f"{folder} holds {n_images} images, but there are {n} positions; each position needs its image"
        )
    files = [folder / f"{number:05d}.png" for number in range(1, n + 1)]
    digest = hashlib.sha256()
    for file in files:
        if not file.is_file():
            raise InputError(f"{file} is missing; images are numbered from 00001.png without gaps")
        digest.update(f"{sha256(file)}  {file.name}\n".encode())
    rows, columns = _decode(files[0], n).shape

    def batches() -> Iterator[Tensor]:
        return (torch.from_numpy(_decode(file, n, (rows, columns)).copy())[None] for file in files)

    return stored((n, rows, columns), torch.uint8, digest.hexdigest, batches), digest.hexdigest()


def _decode(
    file: Path, n: int, expected: tuple[int, int] | None = None
) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    """Return the pixels of one of n images. Its size is checked before: a few kilobytes may claim gigabytes."""
    content = read_bytes(file)

    def opened() -> Image.Image:
        """Open the image. Other formats than PNG are excluded, because Pillow starts programs for some."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            return Image.open(io.BytesIO(content), formats=["PNG"])

    with refusing_broken(file, "a complete PNG image"), opened() as image:
        rows, columns, mode = image.height, image.width, image.mode
        image.verify()  # the checksums; loading alone forgives a missing end
    if mode != "L":
        raise InputError(f"{file} has mode {mode}; a spectrum is an 8-bit grey image")
    if not (rows >= 2 and columns == 4 * rows):
        raise InputError(
            f"{file} has {rows} x {columns} pixels; a spectrum has 4 columns a row "
            "(elevations to 90, azimuths to 360 degrees), e.g. 90 x 360"
        )
    check_pixels(str(file), n, (rows, columns))
    if expected not in (None, (rows, columns)):
        raise InputError(
            f"{file} has {rows} x {columns} pixels, the first image others; all spectra must have one shape"
        )
    with refusing_broken(file, "a complete PNG image"), opened() as image:
        return np.asarray(image)


class Nerf2Rssi(Format[Rssi]):
    """One row a position of the end that moves, one column a receiver."""

    takes = frozenset({"filler", "offset_by"})

    def recognises(self, path: Path) -> bool:
        raw = (path / TABLES[1]).is_file() and any((path / name).is_file() for name in POSITIONS)
        return raw or any((path / name).is_file() for name in (*TABLES[:1], *RECEIVERS[:1]))

    def read(self, path: Path, options: ReadOptions) -> Rssi:
        rssi_file, position_file = _one_of(path, TABLES), _one_of(path, POSITIONS)
        receivers = next((path / name for name in RECEIVERS if (path / name).is_file()), None)
        table, position = read_table(rssi_file), read_xyz(position_file)
        names = list(map(str, table.columns))
        omitted, missing = without_fix(position)
        if omitted.all():
            raise InputError(f"{position_file} needs 3 finite numbers [m] in each row")
        if len(table) != len(position):
            raise InputError(
                f"{path}: {rssi_file.name} has {len(table)} rows, {position_file.name} {len(position)}; they must match"
            )
        rssi = np.stack([column_of_numbers(rssi_file, table, name) for name in names], axis=1)
        fillers = sorted({NOT_DETECTED_DBM, *find_fillers(rssi)}) if options.filler is None else list(options.filler)
        rssi, notes = without_fillers(rssi, fillers)
        row = torch.from_numpy(~omitted).nonzero()[:, 0]
        receiver_position, unknown, bands = None, list[str](), None
        if receivers:
            receiver_position, bands, unknown = read_receivers(receivers, names, None, PlanFrame())
        if position_file.name == "rx_pos.csv":
            missing.append(
                "the receiver moves; RSSI is reciprocal, so it counts as the transmitter and the others as receivers"
            )
        survey, meta = path / SURVEY, path / META
        properties = _properties(survey) if survey.is_file() else {}
        groups = properties.pop("groups", None)
        if options.offset_by not in (None, groups):
            raise InputError(
                f"{path} has groups of {groups}, not of {options.offset_by}; convert the table again by these"
            )
        of_rows, units = _of_rows(meta, len(rssi), groups) if meta.is_file() else ({}, [])
        stated = (position_file, rssi_file, receivers, of_rows and meta, properties and survey)
        return Rssi(
            rssi[row],
            position[row],
            name=path.resolve().name,
            receiver_names=names,
            receiver_position=receiver_position,
            index=row,
            named_splits=kept_splits(read_splits(path, len(rssi), first=0), row, len(rssi)),
            source=digests([file for file in stated if file], path),
            notes=(*notes, *missing, *unknown, *units),
            **({"bands": bands} | properties if bands else properties),
            **{name: values[~omitted] for name, values in of_rows.items()},
        )


def _of_rows(file: Path, n: int, groups: str | None) -> tuple[dict[str, Any], list[str]]:
    """Return session, time and named group of n rows, as far as a table has these columns, and a note on times."""
    table = read_table(file)
    session, time = (column_of(table, role, {}) for role in ("session", "time"))
    columns: dict[str, Any] = {}
    notes: list[str] = []
    if session is not None:
        columns["session"] = text_of(table[session]).to_numpy()
    if time is not None:
        columns["time"], notes = seconds(table[time])
    if groups is not None and "group" in table:
        group = text_of(table["group"])
        columns["groups"] = group.where(group != "").rename(groups)
    if columns and len(table) != n:
        raise InputError(f"{file} has {len(table)} rows, the RSSI {n}; they must match")
    return columns, notes


def _properties(file: Path) -> dict[str, Any]:
    """Return the origin of the coordinates and other properties of all rows, as far as a file states them."""
    content = read_yaml(file)
    properties: dict[str, Any] = {name: str(content[name]) for name in ("groups",) if name in content}
    if unknown := content.keys() - set(PROPERTIES):
        raise InputError(f"{file} states {listed(sorted(unknown))}; it holds {listed(PROPERTIES)} only")
    if "origin" in content:
        degrees = numbers(content["origin"], 2)
        if degrees is None or abs(degrees[0]) > 90 or abs(degrees[1]) > 180:
            raise InputError(f"{file}: origin must be latitude and longitude in degrees, got {content['origin']}")
        properties["origin"] = GeodeticOrigin(*degrees)
    if "floors" in content:
        floors = content["floors"]
        heights = numbers([*floors.values()], len(floors)) if isinstance(floors, dict) else None
        if not heights or list(heights) != sorted(set(heights)):
            raise InputError(f"{file}: floors must be names with ascending heights [m], got {floors}")
        properties["floors"] = Floors(tuple(floors), heights)
    if "receiver_moves" in content:
        if content["receiver_moves"] not in ("true", "false"):
            raise InputError(f"{file}: receiver_moves must be true or false, got {content['receiver_moves']}")
        properties["receiver_moves"] = content["receiver_moves"] == "true"
    with refusing_broken(file, "a description as convert writes it"):
        if not isinstance(labels := content.get("labels", []), list):
            raise TypeError(f"labels is {labels}, expected a list")
        properties["labels"] = tuple(map(str, labels))
        if not isinstance(bands := content.get("bands", []), list):
            raise TypeError(f"bands is {bands}, expected a list")
        properties["bands"] = tuple(map(str, bands)) or None
        offsets = content.get("offsets", {})
        db = offsets.get("offset_db", {})
        values = numbers([content.get("plan_scale", "0"), offsets.get("explained", "0"), *db.values()], len(db) + 2)
        scale, explained, *decibels = values or ()
        properties["plan_scale"] = scale or None
        margin_db = number(content.get("margin_db", "0"))
        if not margin_db >= 0:
            raise ValueError("margin_db must be a number from 0 on")
        properties["margin_db"] = margin_db if "margin_db" in content else None
        if offsets:
            by_name = dict(zip(db, decibels, strict=True))
            properties["offsets"] = Offsets(str(offsets["column"]), str(offsets["reference"]), by_name, explained)
    return properties


def _one_of(path: Path, names: tuple[str, ...]) -> Path:
    """Return the only file with one of these names, and refuse none or several."""
    files = [path / name for name in names if (path / name).is_file()]
    if len(files) > 1:
        raise InputError(f"{path} holds {' and '.join(file.name for file in files)}; keep one of them")
    if not files:
        raise InputError(f"{path / names[0]} is missing")
    return files[0]
