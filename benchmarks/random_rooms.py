"""Walls found in rooms whose walls are known, and how many of those that are called identifiable are right.

random_rooms: 72 spectra of random closed-form rooms, whose planes reflect with signs of three kinds, with phase noise.
built_in_rooms: 72 spectra of the built-in room, as `swiftwrf aoa --mix 0.3 --seed SEED` measures them.
newrf_rooms: a tenth and three tenths of the training spectra of the rooms of NeWRF.

A room is found if all six planes are within 2 cm. A plane is wrong if it is off by more than that and by more than three of
its standard deviations.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from aoa_tables import WALLS
from record import options, write_result
from rooms import mirror_room

from augment.mix import withhold
from swiftwrf import Spectra, datasets, simulated_room
from swiftwrf.choices import Moving
from swiftwrf.models.geometry import GeometryModel
from swiftwrf.models.geometry.search import SIDES

POSITIONS = 72
ROOMS = 4  # of each kind and noise, either end moving in half of them
NOISE = (0.0, 0.2, 0.5)  # standard deviation of the phases [rad]
KINDS = ("one sign", "vertical fields", "any signs")
NEAR = 20.0  # mm
PROBABILITIES = (0, 0.5, 0.9, 0.99, 1.1)  # between which the planes are counted


def drawn(kind: str, generator: torch.Generator) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Offsets of the planes on all sides [m] and their gains."""

    def between(low: float, high: float) -> float:
        return float(low + (high - low) * torch.rand((), generator=generator))

    offset = (between(-0.3, 0.5), between(4.3, 6.0), between(-0.3, 0.5), between(3.9, 5.5), 0.0, between(2.6, 3.2))
    walls, rest = [between(0.3, 0.75) for _ in range(4)], [between(0.2, 0.6) for _ in range(2)]
    if kind == "any signs":
        signs = [1 if between(0, 1) < 0.5 else -1 for _ in SIDES]
    else:
        signs = 4 * [-1] + 2 * [1 if kind == "vertical fields" else -1]
    return offset, tuple(sign * size for sign, size in zip(signs, walls + rest, strict=True))


def measure(data: Spectra, offset: Sequence[float], **options: Any) -> dict[str, Any]:
    """Return the estimate of one room with walls at these offsets [m] along -x, +x, -y, +y, -z, +z."""
    began = time.process_time()
    model = GeometryModel(**options).fit(data)
    seconds, planes = time.process_time() - began, []
    for plane in model.planes:
        side = int((SIDES @ torch.tensor(plane.normal, dtype=SIDES.dtype)).argmax())
        error_mm = 1000 * abs(plane.offset_m - offset[side])
        right = error_mm <= max(NEAR, 3 * plane.std_mm)
        known = {"side": side, "error_mm": error_mm, "right": right, "std_mm": plane.std_mm}
        planes.append(known | {"probability": plane.probability, "certain": plane.certain})
    return {
        "moving": data.moving,
        "offset_m": offset,
        "planes": planes,
        "near": len({plane["side"] for plane in planes if plane["error_mm"] < NEAR}),
        "certain": sum(plane["certain"] for plane in planes),
        "certain_and_wrong": sum(plane["certain"] and not plane["right"] for plane in planes),
        "cpu_seconds": seconds,
    }


@dataclass(frozen=True)
class Config:
    """Sizes of the studies."""

    study: Literal["random_rooms", "built_in_rooms", "newrf_rooms"] = "random_rooms"
    """the study"""
    rooms: int = ROOMS
    """random rooms of each kind and noise"""
    seeds: int = 200
    """seeds of the built-in room, from 0"""


def random_rooms(config: Config) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the kind of each room and its estimate."""
    generator = torch.Generator().manual_seed(0)
    for kind in KINDS:
        for noise in NOISE:
            for number in range(config.rooms):
                offset, gain = drawn(kind, generator)
                planes = dict(zip(map(tuple, SIDES.tolist()), offset, strict=True))
                data = mirror_room(planes, gain, get_args(Moving)[number % 2], POSITIONS, noise)
                yield f"{kind}, {noise} rad", measure(data, offset) | {"gain": gain}


def walls(name: str) -> list[float]:
    """Return the offsets of the walls of a scene along their outward normals [m]."""
    return [x if side % 2 else -x for side, x in enumerate(WALLS[name])]


def built_in_rooms(config: Config) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the built-in room of each seed."""
    for seed in range(config.seeds):
        train, _ = simulated_room(seed=seed).split("random", seed=seed)
        data, _ = withhold(train, 0.3, seed)
        yield (
            f"simulated-room, {len(data)} spectra",
            measure(data, walls("simulated-room"), seed=seed, validation="random"),
        )


def newrf_rooms(config: Config) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the rooms of NeWRF at two measured fractions."""
    for name in ("newrf-bedroom", "newrf-office", "newrf-conference"):
        train, _ = datasets.load(name).split("random")
        for fraction in (0.1, 0.3):
            data, _ = withhold(train, fraction, 0)
            yield f"{name}, {len(data)} spectra", measure(data, walls(name), validation="random")


def main(config: Config) -> None:
    torch.set_num_threads(1)
    rooms: dict[str, list[dict[str, Any]]] = {}
    study = {"random_rooms": random_rooms, "built_in_rooms": built_in_rooms, "newrf_rooms": newrf_rooms}[config.study]
    for kind, found in study(config):
        rooms.setdefault(kind, []).append(found)
        print(kind, {k: v for k, v in found.items() if not isinstance(v, list | tuple)}, flush=True)
    planes = [plane for found in rooms.values() for room in found for plane in room["planes"]]
    shares = {}
    for low, high in itertools.pairwise(PROBABILITIES):
        right = [plane["right"] for plane in planes if low <= plane["probability"] < high]
        shares[f"{low:g} to {min(high, 1):g}"] = {"planes": len(right), "right": sum(right)}
    print(shares)
    write_result(config.study, {"positions": POSITIONS, "near_mm": NEAR, "by_probability": shares, "rooms": rooms})


if __name__ == "__main__":
    main(options(Config))
