"""Trace ray paths in a furnished room or a scene file, and write them as `load_spectra` reads them."""

from __future__ import annotations

import time
from importlib.metadata import version
from pathlib import Path

import torch
from torch import Tensor

from swiftwrf import InputError
from swiftwrf.contrib.raytraced import ROOMS, FurnishedRoom, Tracing, open_scene, trace
from swiftwrf.data.files import sha256
from swiftwrf.data.paths import PropagationPaths
from swiftwrf.data.writing import write_paths
from swiftwrf.runtime.durable import write_json
from tasks.command import run_module
from tasks.configs import ScenesConfig
from tasks.directory import new_directory
from tasks.environment import invocation
from tasks.options import by_name
from tasks.page import figures
from tasks.terminal import console, terminal

PLAN = "scene.svg"  # the room and the positions, seen from above
MAX_ATTEMPTS = 100  # draws of all positions before the region counts as full


def run(config: ScenesConfig) -> None:
    """Draw positions, trace the paths to them, and write paths, record and plan.

    Raises:
        InputError: An option that makes no sense, no such room or scene, positions outside of it, a material that has no
            constants at the carrier, or no Sionna RT or LLVM.
    """
    room, fixed, region = where(config)
    with new_directory(Path(config.out), "a scene") as folder:
        position = draw_positions(room, region, config.positions, config.seed)
        scene = open_scene(config.room, config.frequency, config.scattering)
        began = time.perf_counter()
        tracing = Tracing(config.order, config.scattering > 0, config.diffraction, config.seed)
        traced = {}
        for number, at in enumerate(fixed, start=1):
            name = f"array{number}" if len(fixed) > 1 else ""
            traced[name] = traced_from(trace(scene, at, position, config.moving, tracing), name)
            (folder / name).mkdir(exist_ok=True)
            write_paths(traced[name], folder / name)
        seconds = time.perf_counter() - began
        count = torch.cat([paths.count for paths in traced.values()])
        record = {
            "command": invocation("scenes"),
            "options": by_name(config),
            "source_sha256": {Path(config.room).name: sha256(Path(config.room))} if room is None else {},
            "fixed": fixed.tolist(),
            "region": region.tolist(),
            "surfaces": {s.name: s.material.name for s in scene.surfaces},
            "positions": len(count),
            "line_of_sight": sum(int(paths.line_of_sight.sum()) for paths in traced.values()),
            "paths_per_position": float(count.double().mean()),
            "seconds": seconds,
            "sionna_rt": version("sionna-rt"),
        }
        write_json(folder / "scene.json", record)
        figure, axes = figures.panel(8, 5)
        scene.plot(fixed, position, axes)
        (folder / PLAN).write_text(figures.as_svg(figure, f"Plan of {Path(config.room).stem}"), encoding="utf-8")
    each = record["paths_per_position"]
    ends = f" at {len(fixed)} arrays" if len(fixed) > 1 else ""
    text = f"{len(count)} positions{ends} with {each:.0f} paths each, traced in {seconds:.0f} s: {config.out}"
    terminal.page(record, text, Path(config.out) / PLAN)


def traced_from(paths: PropagationPaths, name: str) -> PropagationPaths:
    """Return the paths of the positions that some path reaches, from the fixed end of a name.

    Raises:
        InputError: None is reached.
    """
    without, of = int((paths.count == 0).sum()), name and f" of {name}"
    if without == len(paths.count):
        raise InputError(f"no path{of} reaches any of the {without} positions; is the fixed end inside the scene?")
    if not without:
        return paths
    console.print(f"positions that no path{of} reaches are left out: {without}")
    return paths.reached


def where(config: ScenesConfig) -> tuple[FurnishedRoom | None, Tensor, Tensor]:
    """Return the room, the positions of the fixed ends (n, 3) and the region of the moving one (2, 3) [m].

    Raises:
        InputError: Either is outside the room, or the fixed end is in its furniture.
    """
    room = ROOMS.get(config.room)
    corners = (config.region[:3], config.region[3:]) if config.region else room.region if room else ()
    region = torch.tensor(corners, dtype=torch.float64).sort(dim=0).values
    fixed = torch.tensor(config.fixed or (room.fixed if room else ()), dtype=torch.float64).reshape(-1, 3)
    if room is None:
        return None, fixed, region
    size = " x ".join(f"{side:g}" for side in room.size)
    for at in fixed[~room.free(fixed)]:
        raise InputError(f"--fixed {_listed(at)} is outside the room of {size} m, at a wall, or in furniture")
    if not bool(((region >= 0) & (region <= torch.tensor(room.size))).all()):
        raise InputError(f"--region {_listed(region.flatten())} is not inside the room of {size} m")
    return room, fixed, region


def _listed(numbers: Tensor) -> str:
    return " ".join(f"{x:g}" for x in numbers.tolist())


def draw_positions(room: FurnishedRoom | None, region: Tensor, count: int, seed: int) -> Tensor:
    """Return random positions in the region, away from walls and furniture, float64 (count, 3) [m].

    Raises:
        InputError: Furniture takes (nearly) all of the region.
    """
    generator = torch.Generator().manual_seed(seed)
    found = torch.empty(0, 3, dtype=torch.float64)
    for _ in range(MAX_ATTEMPTS):
        drawn = region[0] + (region[1] - region[0]) * torch.rand(count, 3, dtype=torch.float64, generator=generator)
        found = torch.cat([found, drawn if room is None else drawn[room.free(drawn)]])
        if len(found) >= count:
            return found[:count]
    raise InputError(f"only {len(found)} of {count} positions are free of walls and furniture; choose another --region")


if __name__ == "__main__":
    raise SystemExit(run_module("tasks.scenes"))
