"""Reader of the NeRF2 layout for RSSI: a table of RSSI, positions with the same rows, and positions of the receivers.

| file | content |
|---|---|
| `gateway_rssi.csv` | a column per receiver, named in the header [dBm]; -100 stands for not detected |
| `tx_pos.csv` or `rx_pos.csv` | header `x,y,z`: positions of the end that moves |
| `gateway_position.yml` | optional: `NAME: [x, y, z]` of receivers with known positions |
| `meta.csv` | optional: a row per measurement, with its session (`session`, `run` or `walk`) and `time` [s] |
| `survey.yml` | optional: `origin: [latitude, longitude]`, `floors: {NAME: height}` [m], `receiver_moves: true` |

The BLE data of the NeRF2 paper are read unchanged: `rssi.csv`, `beacon_pos.csv` and `gateway_pos.csv`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from swiftwrf.data.cells import column_of_numbers, seconds, text_of
from swiftwrf.data.columns import column_of
from swiftwrf.data.coordinates import Floors, GeodeticOrigin, PlanFrame, without_fix
from swiftwrf.data.files import digests, numbers, read_table, read_xyz, read_yaml
from swiftwrf.data.formats.base import RSSI_FORMATS, Format, ReadOptions
from swiftwrf.data.powers import NOT_DETECTED_DBM, find_fillers, without_fillers
from swiftwrf.data.receivers import read_receivers
from swiftwrf.data.rssi import META, SURVEY, Rssi
from swiftwrf.data.splits import kept_splits, read_splits
from swiftwrf.errors import InputError, listed

TABLES = ("gateway_rssi.csv", "rssi.csv")
POSITIONS = ("tx_pos.csv", "rx_pos.csv", "beacon_pos.csv")
RECEIVERS = ("gateway_position.yml", "gateway_pos.csv")
FILES = ("gateway_rssi.csv", *POSITIONS, *RECEIVERS)  # any of which marks the layout


@RSSI_FORMATS.register("nerf2")
class Nerf2Rssi(Format[Rssi]):
    """One row a position of the end that moves, one column a receiver."""

    takes = frozenset({"filler"})

    def recognises(self, path: Path) -> bool:
        raw = (path / TABLES[1]).is_file() and any((path / name).is_file() for name in POSITIONS)
        return raw or any((path / name).is_file() for name in (*TABLES[:1], *RECEIVERS[:1]))

    def read(self, path: Path, options: ReadOptions) -> Rssi:
        table, positions = _one_of(path, TABLES), _one_of(path, POSITIONS)
        receivers = next((path / name for name in RECEIVERS if (path / name).is_file()), None)
        frame, position = read_table(table), read_xyz(positions)
        names = list(map(str, frame.columns))
        omitted, missing = without_fix(position)
        if omitted.all():
            raise InputError(f"{positions} needs 3 finite numbers [m] in each row")
        if len(frame) != len(position):
            raise InputError(
                f"{path}: {table.name} has {len(frame)} rows, {positions.name} {len(position)}; they must match"
            )
        rssi = np.stack([column_of_numbers(table, frame, name) for name in names], axis=1)
        fillers = sorted({NOT_DETECTED_DBM, *find_fillers(rssi)}) if options.filler is None else list(options.filler)
        rssi, notes = without_fillers(rssi, fillers)
        row = torch.from_numpy(~omitted).nonzero()[:, 0]
        receiver_position, unknown = read_receivers(receivers, names, None, PlanFrame()) if receivers else (None, [])
        if positions.name == "rx_pos.csv":
            missing.append(
                "the receiver moves; RSSI is reciprocal, so it counts as the transmitter and the others as receivers"
            )
        meta = path / META
        of_rows, units = _of_rows(meta, len(rssi)) if meta.is_file() else ({}, [])
        survey = path / SURVEY
        properties = _properties(survey) if survey.is_file() else {}
        stated = (positions, table, receivers, of_rows and meta, properties and survey)
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
            **properties,
            **{name: values[~omitted] for name, values in of_rows.items()},
        )


def _of_rows(file: Path, n: int) -> tuple[dict[str, Any], list[str]]:
    """Return session and time of each of n rows, (n,), as far as a table has these columns, and a note on times."""
    frame = read_table(file)
    session, time = (column_of(frame, role, {}) for role in ("session", "time"))
    found: dict[str, Any] = {}
    notes: list[str] = []
    if session is not None:
        found["session"] = text_of(frame[session]).to_numpy()
    if time is not None:
        found["time"], notes = seconds(frame[time])
    if found and len(frame) != n:
        raise InputError(f"{file} has {len(frame)} rows, the RSSI {n}; they must match")
    return found, notes


def _properties(file: Path) -> dict[str, Any]:
    """Return the origin of the coordinates, the floors, and whether the receiver moves, as far as a file states them."""
    content = read_yaml(file)
    found: dict[str, Any] = {}
    if unknown := content.keys() - {"origin", "floors", "receiver_moves"}:
        raise InputError(f"{file} states {listed(sorted(unknown))}; it holds origin, floors and receiver_moves only")
    if "origin" in content:
        degrees = numbers(content["origin"], 2)
        if degrees is None or abs(degrees[0]) > 90 or abs(degrees[1]) > 180:
            raise InputError(f"{file}: origin must be latitude and longitude in degrees, got {content['origin']}")
        found["origin"] = GeodeticOrigin(*degrees)
    if "floors" in content:
        floors = content["floors"]
        heights = numbers([*floors.values()], len(floors)) if isinstance(floors, dict) else None
        if not heights or list(heights) != sorted(set(heights)):
            raise InputError(f"{file}: floors must be names with ascending heights [m], got {floors}")
        found["floors"] = Floors(tuple(floors), heights)
    if "receiver_moves" in content:
        if content["receiver_moves"] not in ("true", "false"):
            raise InputError(f"{file}: receiver_moves must be true or false, got {content['receiver_moves']}")
        found["receiver_moves"] = content["receiver_moves"] == "true"
    return found


def _one_of(path: Path, names: tuple[str, ...]) -> Path:
    """Return the only file with one of these names, and refuse none or several."""
    found = [path / name for name in names if (path / name).is_file()]
    if len(found) > 1:
        raise InputError(f"{path} holds {' and '.join(file.name for file in found)}; keep one of them")
    if not found:
        raise InputError(f"{path / names[0]} is missing")
    return found[0]
