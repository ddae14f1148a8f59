"""Walls found from 72 spectra in random closed-form rooms whose planes reflect with signs of three kinds, with phase noise.

A room is found if all six planes are within 2 cm; a plane called certain is wrong if it is off by more than that and by
more than three of its deviations.
"""

from __future__ import annotations

import time
from typing import Any, get_args

import torch
from record import check_committed, write_result
from rooms import mirror_room

from swiftwrf.choices import Moving
from swiftwrf.models.geometry import GeometryModel
from swiftwrf.models.geometry.search import SIDES

POSITIONS = 72
ROOMS = 4  # of each kind and noise, either end moving in half of them
NOISE = (0.0, 0.2, 0.5)  # standard deviation of the phases [rad]
KINDS = ("one sign", "vertical fields", "any signs")
NEAR = 20.0  # mm


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


def measure(offset: tuple[float, ...], gain: tuple[float, ...], moving: Moving, noise: float) -> dict[str, Any]:
    """Return the estimate of one room."""
    data = mirror_room(dict(zip(map(tuple, SIDES.tolist()), offset, strict=True)), gain, moving, POSITIONS, noise)
    began = time.process_time()
    model = GeometryModel().fit(data)
    seconds, planes = time.process_time() - began, []
    for plane in model.planes:
        side = int((SIDES @ torch.tensor(plane.normal, dtype=SIDES.dtype)).argmax())
        off = 1000 * abs(plane.offset_m - offset[side])
        planes.append({"side": side, "error_mm": off, "std_mm": plane.std_mm, "certain": plane.certain})
    near = {plane["side"] for plane in planes if plane["error_mm"] < NEAR}
    wrong = [p for p in planes if p["certain"] and p["error_mm"] > max(NEAR, 3 * p["std_mm"])]
    return {
        "moving": moving,
        "offset_m": offset,
        "gain": gain,
        "planes": planes,
        "near": len(near),
        "certain": sum(plane["certain"] for plane in planes),
        "certain_and_wrong": len(wrong),
        "cpu_seconds": seconds,
    }


def main() -> None:
    torch.set_num_threads(1)
    generator, rooms = torch.Generator().manual_seed(0), {}
    for kind in KINDS:
        for noise in NOISE:
            found = []
            for number in range(ROOMS):
                moving = get_args(Moving)[number % 2]
                found.append(measure(*drawn(kind, generator), moving, noise))
                print(kind, noise, {k: v for k, v in found[-1].items() if not isinstance(v, list | tuple)}, flush=True)
            rooms[f"{kind}, {noise} rad"] = found
    write_result("random_rooms", {"positions": POSITIONS, "near_mm": NEAR, "rooms": rooms})


if __name__ == "__main__":
    check_committed()
    main()
