"""Planes of any orientation that a room lacks, found by scanning normals and offsets and refined with their tilt."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from swiftwrf.geometry.images import Scene, mirror

HORIZONTAL = 90  # normals of upright walls that are tried
SPHERE = 1200  # normals all around
NEAR = 24  # positions close together, whose waves stay in step over a few degrees of tilt
BATCH = 256


def directions() -> Tensor:
    """Normals to try, float64 (D, 3): all around the horizon, and a Fibonacci lattice on the sphere."""
    around = 2 * math.pi / HORIZONTAL * torch.arange(HORIZONTAL, dtype=torch.float64)
    upright = torch.stack([around.cos(), around.sin(), torch.zeros_like(around)], dim=1)
    number = torch.arange(SPHERE, dtype=torch.float64)
    z, turn = 1 - (2 * number + 1) / SPHERE, math.pi * (3 - math.sqrt(5)) * number
    flat = (1 - z * z).sqrt()
    return torch.cat([upright, torch.stack([flat * turn.cos(), flat * turn.sin(), z], dim=1)])


def candidates(scene: Scene, base: Tensor, gain: float, reach: float, top: int) -> tuple[Tensor, Tensor]:
    """The best further planes in single reflections: normals (C, 3) and offsets (C,) [m], the best first.

    Args:
        scene: all positions; the NEAR ones around their centre are used.
        base: field of what is known already, (n, K).
        gain: that the planes are tried with.
        reach: how far beyond the region of both ends [m].
        top: how many.
    """
    both = torch.cat([scene.transmitter, scene.receiver])
    moving = scene.transmitter if len(scene.transmitter) > 1 else scene.receiver
    rows = (moving - moving.mean(0)).norm(dim=1).argsort()[:NEAR]
    near, base = scene.subset(rows), base[rows]
    found: list[tuple[float, Tensor, float]] = []
    distance = torch.arange(0.5, reach * scene.wavenumber, 0.6, dtype=torch.float64) / scene.wavenumber
    for normal in directions().split(max(1, BATCH // len(distance) * 8)):
        offset = (both @ normal.T).amax(0)[:, None] + distance
        source = mirror(near.transmitter, normal[:, None, None], offset[..., None])
        score = torch.stack([near.score(base + gain * near.wave(s)) for s in source])
        best = score.min(1)
        found += [
            (float(v), n, float(o))
            for v, n, o in zip(best.values, normal, offset.gather(1, best.indices[:, None])[:, 0], strict=True)
        ]
    found.sort(key=lambda f: f[0])
    return torch.stack([f[1] for f in found[:top]]), torch.tensor([f[2] for f in found[:top]], dtype=torch.float64)
