"""Planes of any orientation that a room lacks, found by scanning normals and offsets and refined with their tilt."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from swiftwrf.models.geometry.images import Scene, mirror

HORIZONTAL = 90  # normals of upright walls that are tried
SPHERE = 1200  # normals all around
NEAR = 24  # positions close together, whose waves stay in step over a few degrees of tilt
DIRECTIONS = 4  # at a time
GAIN = 0.7  # that planes are tried with, of either sign


def directions() -> Tensor:
    """Normals to try, float64 (D, 3): all around the horizon, and a Fibonacci lattice on the sphere."""
    around = 2 * math.pi / HORIZONTAL * torch.arange(HORIZONTAL, dtype=torch.float64)
    upright = torch.stack([around.cos(), around.sin(), torch.zeros_like(around)], dim=1)
    number = torch.arange(SPHERE, dtype=torch.float64)
    z, turn = 1 - (2 * number + 1) / SPHERE, math.pi * (3 - math.sqrt(5)) * number
    flat = (1 - z * z).sqrt()
    return torch.cat([upright, torch.stack([flat * turn.cos(), flat * turn.sin(), z], dim=1)])


def candidates(scene: Scene, base: Tensor, reach: float, top: int) -> list[tuple[Tensor, float, float]]:
    """The best further planes in single reflections: normal (3,), offset [m] and sign of the gain, the best first.

    Args:
        scene: all positions; the NEAR ones around their centre are used.
        base: field of what is known already, (n, K).
        reach: how far beyond the region of both ends [m].
        top: how many.
    """
    both = torch.cat([scene.transmitter, scene.receiver])
    rows = (scene.moving - scene.moving.mean(0)).norm(dim=1).argsort()[:NEAR]
    near, base = scene.subset(rows), base[rows]
    found: list[tuple[float, Tensor, float, float]] = []
    distance = torch.arange(0.5, reach * scene.wavenumber, 0.6, dtype=torch.float64) / scene.wavenumber
    for normal in directions().split(DIRECTIONS):
        offset = (both @ normal.T).amax(0)[:, None] + distance
        wave = near.wave(mirror(near.transmitter, normal[:, None, None], offset[..., None]))
        for sign in (-1.0, 1.0):
            best = near.score(base + GAIN * sign * wave).min(1)
            at = offset.gather(1, best.indices[:, None])[:, 0].tolist()
            found += [(v, n, o, sign) for v, n, o in zip(best.values.tolist(), normal, at, strict=True)]
    return [f[1:] for f in sorted(found, key=lambda f: f[0])[:top]]
