"""Ray paths between an end that stays and positions of the one that moves, by Sionna RT.

Rays are shot from the fixed end and bounce; the chains of surfaces that they find are made exact by the image method (J.
Hoydis et al., "Sionna RT: Differentiable Ray Tracing for Radio Propagation Modeling", 2023). Both ends are isotropic and
vertically polarised, so a path is the same in both directions, and a moving transmitter is traced from the receiver.
Sionna's coefficient is that of the passband: the phase of the whole length, -2 pi f delay, is added here. What stands in
the way blocks; nothing is transmitted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.array.planar import LIGHT_SPEED
from swiftwrf.data.raytraced.scene import Scene, sionna
from swiftwrf.data.spectra import Moving
from swiftwrf.runtime.progress import progress_bar

RAYS = 100_000  # that look for chains of surfaces
SCATTERED_RAYS = 300  # each is a path wherever it scatters
AT_ONCE = 8  # positions: chains share a table, which many positions would fill
SAME_M = 1e-3  # image sources that are closer are one, found twice
DIFFUSE = 2  # Sionna's number of a scattering


@dataclass(frozen=True)
class Tracing:
    """How paths are traced.

    Args:
        order: most interactions of a path.
        scattering: whether surfaces scatter.
        diffraction: whether edges diffract, once a path.
        seed: of rays and of the phases of what is scattered.
    """

    order: int = 3
    scattering: bool = False
    diffraction: bool = False
    seed: int = 0


@dataclass(frozen=True, eq=False)
class TracedPaths:
    """Paths of n positions, one position after the other, shortest first.

    Args:
        count: paths of each position, which may be none, int64 (n,).
        direction: unit vectors from the receiver to where the path comes from, world coordinates, float64 (sum, 3).
        length: of the paths [m], float64 (sum,).
        gain: complex amplitude with the phase of the whole length, complex128 (sum,).
        corner: of the path from the transmitter to the receiver, nan after the last one, float64 (sum, order, 3) [m].
        line_of_sight: whether the direct path is free, bool (n,).
    """

    count: Tensor
    direction: Tensor
    length: Tensor
    gain: Tensor
    corner: Tensor
    line_of_sight: Tensor

    @property
    def order(self) -> Tensor:
        """Interactions of each path, int64 (sum,)."""
        return self.corner[..., 0].isfinite().sum(dim=1)

    @property
    def owner(self) -> Tensor:
        """Which position a path belongs to, int64 (sum,)."""
        return torch.arange(len(self.count)).repeat_interleave(self.count)

    @property
    def power_db(self) -> Tensor:
        """Sum of the powers of each position's paths, relative to what is sent, float64 (n,)."""
        return 10 * torch.zeros(len(self.count)).double().index_add(0, self.owner, self.gain.abs().square()).log10()

    @property
    def reached(self) -> TracedPaths:
        """Without the positions that no path reaches."""
        some = self.count > 0
        return replace(self, count=self.count[some], line_of_sight=self.line_of_sight[some])

    def last_point(self, transmitter: Tensor) -> Tensor:
        """Where each path leaves for the receiver, float64 (sum, 3) [m], with transmitters (n, 3) [m]."""
        order, point = self.order, transmitter[self.owner].clone()
        bent = order > 0
        point[bent] = self.corner[bent, order[bent] - 1]
        return point


def trace(
    scene: Scene, fixed: Tensor, position: Tensor, moving: Moving, how: Tracing, shown: bool = True
) -> TracedPaths:
    """All paths between the fixed end and each position of the other.

    Args:
        scene: what to trace in.
        fixed: position of the end that stays, (3,) [m].
        position: of the end that moves, (n, 3) [m].
        moving: which end that is.
        how: most interactions and kinds of them.
        shown: show a progress bar on a terminal.
    """
    found: list[TracedPaths] = []
    with progress_bar(shown) as bar:
        task = bar.add_task("positions traced", total=len(position))
        for some in position.split(AT_ONCE):
            found.append(_some(scene, fixed, some, moving, how))
            bar.advance(task, len(some))
    return TracedPaths(
        **{
            name: torch.cat([getattr(part, name) for part in found])
            for name in (field.name for field in fields(TracedPaths))
        }
    )


def _some(scene: Scene, fixed: Tensor, position: Tensor, moving: Moving, how: Tracing) -> TracedPaths:
    _place(scene.held, fixed, position)
    tables = [_solved(scene.held, how, RAYS, diffuse=False)]
    if how.scattering:
        tables.append(_solved(scene.held, how, SCATTERED_RAYS, diffuse=True))
    table = {name: np.concatenate([part[name] for part in tables]) for name in tables[0]}
    table = {name: values[np.lexsort((table["length"], table["owner"]))] for name, values in table.items()}
    order = np.isfinite(table["corner"][..., 0]).sum(axis=1)
    turn = 2 * math.pi * np.mod(table["length"] * (float(scene.held.frequency[0]) / LIGHT_SPEED), 1.0)
    corner = table["corner"]
    if moving == "transmitter":  # traced the other way round
        back = np.where(
            np.arange(how.order) < order[:, None], order[:, None] - 1 - np.arange(how.order), np.arange(how.order)
        )
        corner = np.take_along_axis(corner, back[..., None], axis=1)
    heard = np.zeros(len(position), dtype=bool)
    heard[table["owner"][order == 0]] = True
    return TracedPaths(
        count=torch.from_numpy(np.bincount(table["owner"], minlength=len(position))),
        direction=torch.from_numpy(table["arrival" if moving == "receiver" else "departure"]),
        length=torch.from_numpy(table["length"]),
        gain=torch.from_numpy(table["gain"] * np.exp(-1j * turn)),
        corner=torch.from_numpy(corner),
        line_of_sight=torch.from_numpy(heard),
    )


def _place(held: Any, fixed: Tensor, position: Tensor) -> None:
    """Puts the ends where they belong: the one that stays is Sionna's transmitter."""
    rt = sionna()
    for name in (*held.transmitters, *held.receivers):
        held.remove(name)
    held.add(rt.Transmitter("fixed", fixed.tolist()))
    for number, place in enumerate(position.tolist()):
        held.add(rt.Receiver(f"moving-{number}", place))


def _solved(held: Any, how: Tracing, rays: int, diffuse: bool) -> dict[str, NDArray[Any]]:
    """Paths as a table: position, departure, arrival, length, gain and corners, those found twice once. With `diffuse` those
    that are scattered somewhere, else all others."""
    paths = sionna().PathSolver(deterministic=True)(
        held,
        max_depth=how.order,
        samples_per_src=rays,
        los=not diffuse,
        specular_reflection=True,
        diffuse_reflection=diffuse,
        refraction=False,
        diffraction=how.diffraction and not diffuse,
        seed=how.seed,
    )
    kept = paths.valid.numpy()[:, 0]
    kind = np.zeros((*kept.shape, how.order), dtype=np.int64)
    depth = len(paths.interactions.numpy()) if kind.size else 0  # as deep as the deepest path
    if depth:
        kind[..., :depth] = np.moveaxis(paths.interactions.numpy()[:, :, 0], 0, -1)
    if diffuse:
        kept &= (kind == DIFFUSE).any(axis=-1)
    owner, path = np.nonzero(kept)
    real, imaginary = (part.numpy()[:, 0, 0, 0] for part in paths.a)
    corner = np.full((len(owner), how.order, 3), np.nan)
    if depth:
        corner[:, :depth] = np.moveaxis(paths.vertices.numpy()[:, :, 0], 0, -2)[owner, path]
    corner[kind[owner, path] == 0] = np.nan
    angles = {
        "departure": (paths.theta_t, paths.phi_t),
        "arrival": (paths.theta_r, paths.phi_r),
    }
    table = {
        "owner": owner,
        "length": paths.tau.numpy()[:, 0][owner, path].astype(np.float64) * LIGHT_SPEED,
        "gain": (real + 1j * imaginary)[owner, path].astype(np.complex128),
        "corner": corner,
        **{
            name: _direction(*(angle.numpy()[:, 0][owner, path].astype(np.float64) for angle in pair))
            for name, pair in angles.items()
        },
    }
    return table if diffuse else {name: values[_first(table)] for name, values in table.items()}


def _direction(zenith: NDArray[Any], azimuth: NDArray[Any]) -> NDArray[Any]:
    flat = np.sin(zenith)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.cos(zenith)], axis=-1)


def _first(table: dict[str, NDArray[Any]]) -> NDArray[Any]:
    """Rows without those that repeat an earlier path of their position: neighbouring triangles may find one twice."""
    image = table["length"][:, None] * table["arrival"]
    rows = [
        mine[~np.tril(np.linalg.norm(image[mine][:, None] - image[mine], axis=-1) < SAME_M, -1).any(axis=1)]
        for mine in (np.flatnonzero(table["owner"] == number) for number in np.unique(table["owner"]))
    ]
    return np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)
