"""Reader of DeepMIMO v4 folders, the exchange format of ray tracers (Sionna RT, Wireless InSite, AODT): one array a file.

`{key}_t{set}_tx{index}_r{set}.npz` holds `key`: power [dB], phase [deg], delay [s], aoa_az, aoa_el [deg] of up to 25 paths a
receiver, nan where there are fewer, and rx_pos, tx_pos [m]; params.json the carrier and the ray tracer. aoa_el is the angle
from the zenith. The angles point from the receiver to where the path comes from, in world coordinates.

Wireless InSite gives the phase of a path over its whole length; Sionna that of its passband coefficient, to which the phase
-2 pi f delay of the propagation is to be added. Which it is shows at the direct paths, whose phase is the propagation's.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from swiftwrf.array.planar import LIGHT_SPEED
from swiftwrf.data.archives import read_arrays
from swiftwrf.data.files import FARTHEST, check_carrier, read_text
from swiftwrf.data.formats.base import SPECTRA_FORMATS, Format
from swiftwrf.data.rays import Rays
from swiftwrf.data.reading import Reading
from swiftwrf.data.spectra import GRID, Spectra, check_pixels
from swiftwrf.errors import InputError

KEYS = ("power", "phase", "delay", "aoa_az", "aoa_el")
FILE = re.compile(r"power_(t\d+_tx\d+_r\d+)\.npz")
SIONNA = "sionna"  # in the name of the ray tracer
SHORTEST, LONGEST = 0.9, 100.0  # that the shortest path may be, in distances: beyond, units are wrong
DIRECT = 0.01  # relative: a path hardly longer than the distance is the direct one
STEADY = 0.5  # mean resultant length of phases beyond which they are one phase
OFF = 15.0  # [deg] that direct paths may come from beside the line of sight
FEW = 10  # direct paths that tell the conventions


@SPECTRA_FORMATS.register("deepmimo")
class DeepMimo(Format[Spectra]):
    """Paths of a ray tracer, turned into spectra; of several pairs of transmitter and receivers, the one asked for."""

    takes = frozenset({"array", "grid", "every", "station"})

    def recognises(self, path: Path) -> bool:
        return bool(_pairs(path))

    def read(self, path: Path, how: Reading) -> Spectra:
        pairs = _pairs(path)
        if (how.station is None and len(pairs) > 1) or not 1 <= (how.station or 1) <= len(pairs):
            listed = ", ".join(f"{number} {pair}" for number, pair in enumerate(pairs[:8], start=1))
            raise InputError(
                f"{path} holds {len(pairs)} pairs of transmitter and receivers; choose one by its number: station ({listed})"
            )
        pair = pairs[(how.station or 1) - 1]
        frequency, tracer = _params(path / "params.json")
        rays, notes = _rays(path, pair, frequency, tracer, how)
        files = [path / "params.json", *(path / f"{key}_{pair}.npz" for key in (*KEYS, "rx_pos", "tx_pos"))]
        return rays.spectra(path, how, files, notes=notes)


def _pairs(path: Path) -> list[str]:
    found = (FILE.fullmatch(file.name) for file in path.iterdir()) if path.is_dir() else ()
    return sorted(match[1] for match in found if match)


def _params(file: Path) -> tuple[float, str]:
    """Carrier [Hz] and name of the ray tracer."""
    try:
        given = json.loads(read_text(file))["rt_params"]
        frequency, tracer = float(given["frequency"]), str(given.get("raytracer_name", ""))
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{file} must be JSON with rt_params, and in it frequency, the carrier in Hz ({error!r})"
        ) from None
    check_carrier(file, frequency)
    return frequency, tracer


def _rays(folder: Path, pair: str, frequency: float, tracer: str, how: Reading) -> tuple[Rays, tuple[str, ...]]:
    table, receiver, transmitter = _tables(folder, pair)
    rows = np.arange(0, len(receiver), how.every or 1)
    table, receiver = {key: values[rows] for key, values in table.items()}, receiver[rows]
    known = np.isfinite(np.stack(list(table.values()))).all(axis=0) & (table["power"] > -math.inf)
    has_path = known.any(axis=1)
    notes = []
    if not has_path.all():
        notes.append(f"receivers without a path are left out: {int((~has_path).sum())}")
    if not has_path.any():
        raise InputError(f"{folder} has no receiver with a path for pair {pair}")
    rows, receiver, known = rows[has_path], receiver[has_path], known[has_path]
    table = {key: values[has_path] for key, values in table.items()}
    check_pixels(str(folder), len(receiver), how.grid or GRID)
    away = transmitter - receiver
    distance = np.linalg.norm(away, axis=1)
    if not (distance > 0).all():
        raise InputError(
            f"{folder}: receiver {int(rows[distance.argmin()])} of pair {pair} is at the transmitter; leave it out"
        )
    detour = np.where(known, table["delay"] * LIGHT_SPEED / distance[:, None], math.inf)
    shortest = float(np.median(detour.min(axis=1)))
    if not SHORTEST <= shortest <= LONGEST:
        raise InputError(
            f"{folder}: shortest paths are {shortest:.3g} times as long as the distance (median), so positions are not in "
            "metres or delays not in seconds"
        )
    line, path = np.nonzero(np.abs(detour - 1) < DIRECT)
    angles = table["aoa_az"], table["aoa_el"]
    if max(np.abs(angle[known]).max() for angle in angles) <= 2 * math.pi:
        raise InputError(f"{folder}: no angle is beyond 2 pi, so they look like radians; aoa_az and aoa_el are degrees")
    if len(line) >= FEW:
        _check_angles(folder, angles[0][line, path], angles[1][line, path], (away / distance[:, None])[line])
    direction = _direction(angles[0][known], angles[1][known])
    phase = np.deg2rad(table["phase"])
    turned = 2 * math.pi * frequency * table["delay"]
    said = _convention(phase[line, path], turned[line, path], tracer)
    if said == "passband":
        phase = phase - turned
        notes.append("phases are those of passband coefficients; exp(-j 2 pi f delay) of the propagation is added")
    elif said == "reversed":
        phase = -phase
        notes.append("phases grow with the delay; they are reversed, for a wave lags behind")
    gain = 10 ** ((table["power"] - table["power"][known].max()) / 20) * np.exp(1j * phase)
    clear = np.zeros(len(receiver), dtype=bool)
    clear[line] = True
    return (
        Rays(
            transmitter=torch.from_numpy(np.broadcast_to(transmitter, receiver.shape).copy()),
            receiver=torch.from_numpy(receiver),
            count=torch.from_numpy(known.sum(axis=1)),
            direction=torch.from_numpy(direction),
            gain=torch.from_numpy(gain[known]),
            line_of_sight=torch.from_numpy(clear),
            index=torch.from_numpy(rows),
            frequency_hz=frequency,
        ),
        tuple(notes),
    )


def _tables(folder: Path, pair: str) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.float64], NDArray[np.float64]]:
    """Paths by key, (n, paths), and positions of receivers (n, 3) and transmitter (3,)."""
    arrays: dict[str, NDArray[Any]] = {}
    for key in (*KEYS, "rx_pos", "tx_pos"):
        file = folder / f"{key}_{pair}.npz"
        arrays[key] = read_arrays(file, [key])[key]
        if arrays[key].dtype.kind not in "iuf":
            raise InputError(f"{file} must hold real numbers, got {arrays[key].dtype}")
        arrays[key] = arrays[key].astype(np.float64)
    receiver, transmitter = arrays.pop("rx_pos"), arrays.pop("tx_pos").reshape(-1)
    shape = arrays["power"].shape
    if len(shape) != 2 or 0 in shape or any(values.shape != shape for values in arrays.values()):
        shapes = ", ".join(f"{key} {values.shape}" for key, values in arrays.items())
        raise InputError(f"{folder}: the paths of pair {pair} must all have shape (receivers, paths), got {shapes}")
    if receiver.shape != (shape[0], 3) or transmitter.shape != (3,):
        raise InputError(
            f"{folder}: expected rx_pos ({shape[0]}, 3) and tx_pos (3,), got {receiver.shape} and {transmitter.shape}"
        )
    if not (np.abs(receiver) <= FARTHEST).all() or not (np.abs(transmitter) <= FARTHEST).all():
        raise InputError(f"{folder}: positions of pair {pair} must be finite numbers [m], at most {FARTHEST:g}")
    return arrays, receiver, transmitter


def _direction(azimuth: NDArray[Any], zenith: NDArray[Any]) -> NDArray[Any]:
    """Unit vectors (..., 3) of angles [deg]."""
    azimuth, zenith = np.deg2rad(azimuth), np.deg2rad(zenith)
    return np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=-1)


def _check_angles(folder: Path, azimuth: NDArray[Any], zenith: NDArray[Any], towards: NDArray[Any]) -> None:
    """Refuses angles of another convention, which the direct paths betray: they come from the transmitter.

    Args:
        azimuth, zenith: of direct paths, (m,) [deg].
        towards: unit vectors from their receivers to the transmitter, (m, 3).

    Raises:
        InputError: an elevation from the horizon, angles that point the other way, or a frame of their own.
    """

    def off(claimed: NDArray[Any]) -> float:
        return float(np.rad2deg(np.median(np.arccos(np.clip((claimed * towards).sum(1), -1, 1)))))

    declared = off(_direction(azimuth, zenith))
    if declared <= OFF:
        return
    others = {
        "aoa_el is the angle from the horizon; give that from the zenith, 90 - aoa_el": _direction(
            azimuth, 90 - zenith
        ),
        "the angles say where a path goes; give those from the receiver to where it comes from": -_direction(
            azimuth, zenith
        ),
        "x and y are swapped in the angles or in the positions": _direction(90 - azimuth, zenith),
        "aoa_az turns clockwise; give it counter-clockwise from x": _direction(-azimuth, zenith),
    }
    meaning, best = min(((meaning, off(claimed)) for meaning, claimed in others.items()), key=lambda found: found[1])
    reason = f"it would fit if {meaning}" if best <= OFF else "positions and angles are in different frames or units"
    raise InputError(
        f"{folder}: direct paths come from {declared:.0f} degrees beside the transmitter (median); {reason}"
    )


def _convention(phase: NDArray[Any], turned: NDArray[Any], tracer: str) -> str:
    """What phases [rad] are, by the one constant that is left of the direct paths, and else by the ray tracer's name: of the
    whole length (`whole`), of the passband coefficient, or of the whole length with the sign `reversed`."""
    if len(phase) >= FEW:
        steady = {"whole": phase + turned, "passband": phase, "reversed": phase - turned}
        length = {name: abs(np.exp(1j * left).mean()) for name, left in steady.items()}
        best = max(length, key=lambda name: length[name])
        if length[best] > STEADY:
            return best
    return "passband" if SIONNA in tracer.lower() else "whole"
