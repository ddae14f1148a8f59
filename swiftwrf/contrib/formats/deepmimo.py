"""Reader and writer of DeepMIMO v4 folders, the exchange format of ray tracers (Sionna RT, Wireless InSite, AODT).

`{key}_t{set}_tx{index}_r{set}.npz` holds one array, `key`. Arrays of paths have up to 25 paths a receiver, nan for missing
ones. params.json holds the carrier and the name of the ray tracer.

- power [dB], phase [deg], delay [s].
- aoa_az and aoa_el [deg]: direction from the receiver against the arriving path, in world coordinates. aoa_el is the angle
  from the zenith, or from the horizon (AODT). Direct paths determine which.
- inter: interactions of a path as digits (0 line of sight, 1 reflection, 2 diffraction, 3 scattering, 4 transmission).
- rx_pos and tx_pos [m].

Wireless InSite gives the phase of a path over its whole length. Sionna gives that of the passband coefficient, to which the
phase -2 pi f delay of the propagation is added here. The line-of-sight paths, whose phase is known, show the convention.
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

from swiftwrf.array.angles import angular_distance, to_angles, to_direction
from swiftwrf.array.planar import LIGHT_SPEED
from swiftwrf.data.archives import read_arrays, refusing_broken
from swiftwrf.data.files import check_carrier, digests, read_text
from swiftwrf.data.formats.base import Format, ReadOptions, station
from swiftwrf.data.paths import PropagationPaths
from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError
from swiftwrf.positions import check_positions
from swiftwrf.runtime.durable import write_npz, write_text
from swiftwrf.runtime.plain import read_json

Floats = NDArray[np.float64]
KEYS = ("power", "phase", "delay", "aoa_az", "aoa_el")
INTERACTIONS = "inter"
FILE = re.compile(r"power_(t\d+_tx\d+_r\d+)\.npz")
DIRECT_DETOUR = 0.01  # relative: without interactions, a path that is at most this much longer counts as direct
MAX_ANGLE_OFFSET_DEG = 15.0  # median angle between direct paths and the line of sight
MIN_DIRECT_PATHS = 10  # that show the conventions
NO_INTERACTIONS = (
    "there are no interactions (inter), so a receiver counts as line of sight if a path is at most "
    f"{DIRECT_DETOUR:.0%} longer than the distance"
)


class DeepMimo(Format[Spectra]):
    """Paths of a ray tracer, from which spectra are computed; `station` chooses a pair of transmitter and receivers."""

    takes = frozenset({"array", "grid", "every", "station", "subcarriers", "bandwidth"})

    def recognises(self, path: Path) -> bool:
        return bool(_pairs(path))

    def stations(self, path: Path) -> list[str]:
        return _pairs(path)

    def read(self, path: Path, options: ReadOptions) -> Spectra:
        pairs = _pairs(path)
        pair = pairs[station(f"{path} holds {len(pairs)} pairs of transmitter and receivers", pairs, options.station)]
        params = path / "params.json"
        with refusing_broken(params, "JSON with rt_params, and in it frequency, the carrier in Hz"):
            given = read_json(read_text(params))["rt_params"]
            frequency, tracer = float(given["frequency"]), str(given.get("raytracer_name", ""))
        check_carrier(params, frequency)
        table = _table(path, pair)
        files = [path / f"{key}_{pair}.npz" for key in table]
        known = np.isfinite(np.stack([table[key] for key in KEYS])).all(axis=0) & (table["power"] > -math.inf)
        index = np.arange(0, len(known), options.every or 1)
        reached = known[index].any(axis=1)
        if not reached.any():
            raise InputError(f"{path} has no receiver with a path for pair {pair}")
        notes = [] if reached.all() else [f"receivers without a path are left out: {int((~reached).sum())}"]
        index = index[reached]
        table |= {key: values[index] for key, values in table.items() if key != "tx_pos"}
        paths, found = _paths(path, table, known[index], frequency, tracer)
        return paths.spectra(
            path.resolve().name,
            options.array,
            options.grid,
            subcarriers=options.subcarriers,
            bandwidth_hz=options.bandwidth,
            index=torch.from_numpy(index),
            source=digests([params, *files]),
            notes=(*notes, *found),
        )


def _pairs(path: Path) -> list[str]:
    found = (FILE.fullmatch(file.name) for file in path.iterdir()) if path.is_dir() else ()
    return sorted(match[1] for match in found if match)


def _table(folder: Path, pair: str) -> dict[str, Floats]:
    """Return the paths by key, (n, paths), and positions: of receivers rx_pos (n, 3), of the transmitter tx_pos (3,)."""
    arrays: dict[str, Floats] = {}
    keys = [*KEYS, *([INTERACTIONS] if (folder / f"{INTERACTIONS}_{pair}.npz").is_file() else [])]
    for key in (*keys, "rx_pos", "tx_pos"):
        file = folder / f"{key}_{pair}.npz"
        values = read_arrays(file, [key])[key]
        if values.dtype.kind not in "iuf":
            raise InputError(f"{file} must hold real numbers, got {values.dtype}")
        arrays[key] = values.astype(np.float64)
    arrays["tx_pos"] = arrays["tx_pos"].reshape(-1)
    shape = arrays["power"].shape
    if len(shape) != 2 or 0 in shape or any(arrays[key].shape != shape for key in keys):
        shapes = ", ".join(f"{key} {arrays[key].shape}" for key in keys)
        raise InputError(f"{folder}: the paths of pair {pair} must all have shape (receivers, paths), got {shapes}")
    check_positions(arrays["rx_pos"], f"{folder}: rx_pos of pair {pair}", (shape[0], 3))
    check_positions(arrays["tx_pos"], f"{folder}: tx_pos of pair {pair}", (3,))
    return arrays


def _paths(
    folder: Path, table: dict[str, Floats], known: NDArray[np.bool_], frequency: float, tracer: str
) -> tuple[PropagationPaths, list[str]]:
    """Return the known paths of receivers that have one, and notes on their conventions."""
    receiver, transmitter = table["rx_pos"], table["tx_pos"]
    away = transmitter - receiver
    distance = np.linalg.norm(away, axis=1)
    if not (distance > 0).all():
        raise InputError(f"{folder}: a receiver at {receiver[distance.argmin()].tolist()} m is at the transmitter")
    detour = np.where(known, table["delay"] * LIGHT_SPEED / distance[:, None], math.inf)
    shortest = float(np.median(detour.min(axis=1)))
    if not 0.9 <= shortest <= 100.0:  # times the distance
        raise InputError(
            f"{folder}: shortest paths are {shortest:.3g} times as long as the distance (median), so positions are not in "
            "metres or delays not in seconds"
        )
    azimuth, zenith = table["aoa_az"], table["aoa_el"]
    if max(np.abs(azimuth[known]).max(), np.abs(zenith[known]).max()) <= 2 * math.pi:
        raise InputError(f"{folder}: no angle is beyond 2 pi, so they look like radians; aoa_az and aoa_el are degrees")
    if INTERACTIONS in table:
        direct, notes = known & (table[INTERACTIONS] == 0), []
    else:
        direct, notes = np.abs(detour - 1) < DIRECT_DETOUR, [NO_INTERACTIONS]
    if _from_horizon(folder, azimuth, zenith, direct, away, known):
        zenith = 90 - zenith
        notes.append("aoa_el is the angle from the horizon, as of AODT; 90 - aoa_el is taken")
    phase, lag = np.deg2rad(table["phase"]), 2 * math.pi * frequency * table["delay"]
    convention = _convention(phase[direct], lag[direct], tracer)
    if convention == "passband":
        phase = phase - lag
        notes.append("phases are those of passband coefficients; exp(-j 2 pi f delay) of the propagation is added")
    elif convention == "reversed":
        phase = -phase
        notes.append("phases grow with the delay; they are reversed, for a wave lags behind")
    gain = 10 ** ((table["power"] - table["power"][known].max()) / 20) * np.exp(1j * phase)
    paths = PropagationPaths(
        transmitter=torch.from_numpy(np.broadcast_to(transmitter, receiver.shape).copy()),
        receiver=torch.from_numpy(receiver),
        count=torch.from_numpy(known.sum(axis=1)),
        direction=torch.from_numpy(_direction(azimuth[known], zenith[known])),
        gain=torch.from_numpy(gain[known]),
        line_of_sight=torch.from_numpy(direct.any(axis=1)),
        frequency_hz=frequency,
    )
    return paths, notes


def _direction(azimuth: Floats, zenith: Floats) -> Floats:
    """Return unit vectors (..., 3) of angles [deg]."""
    elevation = torch.from_numpy(90 - zenith).deg2rad()
    return to_direction(torch.from_numpy(azimuth).deg2rad(), elevation).numpy()


def _from_horizon(
    folder: Path, azimuth: Floats, zenith: Floats, direct: NDArray[np.bool_], away: Floats, known: NDArray[np.bool_]
) -> bool:
    """Return True if elevations count from the horizon, and refuse other conventions than those of docs/formats.md.

    Direct paths come from the transmitter, `away` (n, 3) from the receivers. They reveal the convention of angles (n, paths)
    [deg]. With few of them negative angles do.
    """
    if direct.sum() < MIN_DIRECT_PATHS:
        return bool((zenith[known] < 0).any())
    azimuth, zenith, away = azimuth[direct], zenith[direct], away[direct.nonzero()[0]]

    def offset(claimed: Floats) -> float:
        """Return the median angle [deg] to the transmitter."""
        return float(angular_distance(torch.from_numpy(claimed), torch.from_numpy(away)).rad2deg().median())

    declared, horizon = offset(_direction(azimuth, zenith)), offset(_direction(azimuth, 90 - zenith))
    if min(declared, horizon) <= MAX_ANGLE_OFFSET_DEG:
        return horizon < declared
    others: dict[str, Any] = {
        "the angles are directions of propagation; give those from the receiver against the arriving path": (
            azimuth + 180,
            180 - zenith,
        ),
        "x and y are swapped in the angles or in the positions": (90 - azimuth, zenith),
        "aoa_az turns clockwise; give it counter-clockwise from x": (-azimuth, zenith),
    }
    offsets = {meaning: offset(_direction(*angles)) for meaning, angles in others.items()}
    meaning = min(offsets, key=lambda meaning: offsets[meaning])
    fits = offsets[meaning] <= MAX_ANGLE_OFFSET_DEG
    reason = f"it would fit if {meaning}" if fits else "positions and angles are in different frames or units"
    raise InputError(
        f"{folder}: direct paths come from {declared:.0f} degrees beside the transmitter (median); {reason}"
    )


def _convention(phase: Floats, lag: Floats, tracer: str) -> str:
    """Return the convention of phases [rad]: of the whole length (`whole`), of the `passband` coefficient, or `reversed`.

    The right one makes the residual phase of direct paths constant. With few of them the ray tracer's name decides.
    """
    if len(phase) >= MIN_DIRECT_PATHS:
        residual = {"whole": phase + lag, "passband": phase, "reversed": phase - lag}
        resultant = {name: abs(np.exp(1j * left).mean()) for name, left in residual.items()}
        best = max(resultant, key=lambda name: resultant[name])
        if resultant[best] > 0.5:  # mean resultant length of phases that count as constant
            return best
    return "passband" if "sionna" in tracer.lower() else "whole"


def write_deepmimo(paths: PropagationPaths, folder: Path) -> None:
    """Write paths of known length from one transmitter as a folder of a DeepMIMO v4 scenario, which `load_spectra` reads.

    Interactions (`inter`) are 0 for direct paths and nan for others, whose kinds the paths do not contain.

    Raises:
        InputError: Unknown lengths, or several transmitters.
    """
    if paths.length is None:
        raise InputError("DeepMIMO contains delays, but the lengths of these paths are unknown (length in paths.npz)")
    if len(transmitter := paths.transmitter.unique(dim=0)) > 1:
        raise InputError(
            f"DeepMIMO has one transmitter and many receivers, but these paths have {len(transmitter)} transmitters"
        )
    distance = (paths.transmitter - paths.receiver).norm(dim=1)
    away = (paths.length / distance[paths.owner] - 1).abs()
    direct = paths.line_of_sight[paths.owner] & (away < 1e-6)  # from rounding
    azimuth, _ = to_angles(paths.direction)
    zenith = paths.direction[:, 2].clamp(-1, 1).acos()  # beyond 90 degrees for paths from below
    columns = {
        "power": 20 * paths.gain.abs().log10(),
        "phase": paths.gain.angle().rad2deg(),
        "delay": paths.length / LIGHT_SPEED,
        "aoa_az": azimuth.rad2deg(),
        "aoa_el": zenith.rad2deg(),
        "inter": torch.where(direct, 0.0, torch.nan),
    }
    first = paths.count.cumsum(0) - paths.count
    place = paths.owner, torch.arange(len(paths.gain)) - first[paths.owner]
    empty = torch.full((len(paths.count), int(paths.count.max())), torch.nan, dtype=torch.float64)
    arrays = {name: empty.index_put(place, values.double()) for name, values in columns.items()}
    for name, values in (arrays | {"rx_pos": paths.receiver, "tx_pos": transmitter}).items():
        write_npz(folder / f"{name}_t000_tx000_r001.npz", {name: values.numpy()})
    params = {"rt_params": {"frequency": paths.frequency_hz, "raytracer_name": "SwiftWRF"}}
    write_text(folder / "params.json", json.dumps(params, indent=1) + "\n")
