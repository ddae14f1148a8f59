"""Candidates for further planes of any orientation, from a scan of normals and offsets."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from swiftwrf.models.geometry.batched import batched, batched_field, batched_score
from swiftwrf.models.geometry.images import PhaseObservations
from swiftwrf.runtime.threads import parallel_map

N_HORIZONTAL_NORMALS = 90  # of upright walls
N_SPHERE_NORMALS = 1200  # in all directions
N_NEAR = 24  # positions close together, whose waves stay in phase over a few degrees of tilt
BATCH_SIZE = 4  # normals
FURTHER_GAIN = 0.7  # modulus of the gain that planes are tried with
MIN_DISTANCE_RAD, DISTANCE_STEP_RAD = 0.5, 0.6  # of the scanned offsets beyond both ends, in phase


def directions() -> Tensor:
    """Return normals to try, float64 (D, 3): all around the horizon, and a Fibonacci lattice on the sphere."""
    around = 2 * math.pi / N_HORIZONTAL_NORMALS * torch.arange(N_HORIZONTAL_NORMALS, dtype=torch.float64)
    upright = torch.stack([around.cos(), around.sin(), torch.zeros_like(around)], dim=1)
    number = torch.arange(N_SPHERE_NORMALS, dtype=torch.float64)
    z, turn = 1 - (2 * number + 1) / N_SPHERE_NORMALS, math.pi * (3 - math.sqrt(5)) * number
    flat = (1 - z * z).sqrt()
    return torch.cat([upright, torch.stack([flat * turn.cos(), flat * turn.sin(), z], dim=1)])


def candidates(scene: PhaseObservations, base: Tensor, reach: float, top: int) -> list[tuple[Tensor, float, float]]:
    """Return the best further planes by single reflections: normal (3,), offset [m] and sign of the gain, the best first.

    Args:
        scene: All positions, of which the 24 nearest to their centre are used.
        base: Field of the known planes (n, K).
        reach: Distance beyond the region of both ends up to which planes are scanned [m].
        top: Number of planes.
    """
    both = torch.cat([scene.transmitter, scene.receiver])
    rows = (scene.moving - scene.moving.mean(0)).norm(dim=1).argsort()[:N_NEAR]
    near, base = scene.subset(rows), batched(base[rows])
    farthest = max(reach * scene.wavenumber, MIN_DISTANCE_RAD)
    distance = torch.arange(MIN_DISTANCE_RAD, farthest, DISTANCE_STEP_RAD, dtype=torch.float64) / scene.wavenumber
    if not len(distance):
        return []

    def of_normals(normal: Tensor) -> list[tuple[float, Tensor, float, float]]:
        found = []
        offset = (both @ normal.T).amax(0)[:, None] + distance
        planes = normal.repeat_interleave(len(distance), dim=0)[:, None], offset.reshape(-1, 1)
        wave = FURTHER_GAIN * batched_field(near, *planes, torch.ones(offset.numel(), 1), [(0,)])
        for sign in (-1.0, 1.0):
            best = batched_score(near, base + sign * wave).view_as(offset).min(1)
            at = offset.gather(1, best.indices[:, None])[:, 0].tolist()
            found += [(v, n, o, sign) for v, n, o in zip(best.values.tolist(), normal, at, strict=True)]
        return found

    found = itertools.chain.from_iterable(parallel_map(of_normals, directions().split(BATCH_SIZE)))
    return [f[1:] for f in sorted(found, key=lambda f: f[0])[:top]]
