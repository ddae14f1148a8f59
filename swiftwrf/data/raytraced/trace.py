"""Propagation paths between a fixed end and positions of the moving one, by Sionna RT.

Rays are launched from the fixed end and reflected; the image method makes the chains of surfaces that they find exact (J.
Hoydis et al., "Sionna RT: Differentiable Ray Tracing for Radio Propagation Modeling", 2023). Both ends are isotropic and
vertically polarised, so paths are reciprocal, and a moving transmitter is traced from the receiver. Sionna's coefficient is
that of the passband; the phase of the whole length, -2 pi f delay, is added here. Obstacles block, without transmission.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.array.angles import to_direction
from swiftwrf.array.planar import LIGHT_SPEED
from swiftwrf.choices import Moving
from swiftwrf.data.paths import PropagationPaths
from swiftwrf.data.raytraced.scene import Scene, sionna
from swiftwrf.runtime.progress import progress_bar
from swiftwrf.runtime.validation import NonNegativeInt, configuration

SEARCH_RAYS = 30_000  # that search for chains of surfaces
SCATTERED_RAYS = 300  # each is a path wherever it scatters
BATCH_POSITIONS = 32  # chains share a table, which many positions would fill
SAME_IMAGE_M = 1e-3  # distance below which two image sources are one, found twice
DIFFUSE = 2  # Sionna's number of a scattering
Table = dict[str, NDArray[Any]]


@configuration
class Tracing:
    """Options of ray tracing."""

    order: NonNegativeInt = 3
    """largest number of interactions of a path"""
    scattering: bool = False
    """whether surfaces scatter"""
    diffraction: bool = False
    """whether edges diffract, once a path"""
    seed: NonNegativeInt = 0
    """seed of rays and of the phases of scattered paths"""


def trace(
    scene: Scene, fixed: Tensor, position: Tensor, moving: Moving, tracing: Tracing, progress: bool = True
) -> PropagationPaths:
    """Return all paths between the fixed end and each position of the moving one, shortest first.

    Args:
        scene: Scene to trace in.
        fixed: Position of the fixed end, (3,) [m].
        position: Positions of the moving end, (n, 3) [m].
        moving: The end that moves: "transmitter" or "receiver".
        tracing: Kinds and numbers of interactions.
        progress: Show a progress bar on a terminal.
    """
    found: list[PropagationPaths] = []
    with progress_bar(progress) as bar:
        task = bar.add_task("positions traced", total=len(position))
        for some in position.split(BATCH_POSITIONS):
            found.append(_trace_batch(scene.held, fixed.double(), some.double(), moving, tracing))
            bar.advance(task, len(some))
    return PropagationPaths.joined(found)


def _trace_batch(held: Any, fixed: Tensor, position: Tensor, moving: Moving, tracing: Tracing) -> PropagationPaths:
    _place(held, fixed, position)
    tables = [_solve(held, tracing, SEARCH_RAYS, diffuse=False)]
    if tracing.scattering:
        tables.append(_solve(held, tracing, SCATTERED_RAYS, diffuse=True))
    table = {name: np.concatenate([part[name] for part in tables]) for name in tables[0]}
    table = {name: values[np.lexsort((table["length"], table["owner"]))] for name, values in table.items()}
    order = np.isfinite(table["corner"][..., 0]).sum(axis=1)
    frequency = float(held.frequency[0])
    turn = 2 * math.pi * np.mod(table["length"] * (frequency / LIGHT_SPEED), 1.0)
    corner = table["corner"]
    if moving == "transmitter":  # traced from the receiver
        step = np.arange(tracing.order)
        backwards = np.where(step < order[:, None], order[:, None] - 1 - step, step)
        corner = np.take_along_axis(corner, backwards[..., None], axis=1)
    line_of_sight = np.zeros(len(position), dtype=bool)
    line_of_sight[table["owner"][order == 0]] = True
    ends = (position, fixed.expand_as(position))
    transmitter, receiver = ends if moving == "transmitter" else ends[::-1]
    return PropagationPaths(
        transmitter=transmitter,
        receiver=receiver,
        count=torch.from_numpy(np.bincount(table["owner"], minlength=len(position))),
        direction=torch.from_numpy(table["arrival" if moving == "receiver" else "departure"]),
        gain=torch.from_numpy(table["gain"] * np.exp(-1j * turn)),
        line_of_sight=torch.from_numpy(line_of_sight),
        frequency_hz=frequency,
        length=torch.from_numpy(table["length"]),
        corner=torch.from_numpy(corner),
    )


def _place(held: Any, fixed: Tensor, position: Tensor) -> None:
    """Put the fixed end into the scene as Sionna's transmitter, and the positions as its receivers."""
    rt = sionna()
    for name in (*held.transmitters, *held.receivers):
        held.remove(name)
    held.add(rt.Transmitter("fixed", fixed.tolist()))
    for number, place in enumerate(position.tolist()):
        held.add(rt.Receiver(f"moving-{number}", place))


def _solve(held: Any, tracing: Tracing, rays: int, diffuse: bool) -> Table:
    """Return the distinct paths: owner, departure, arrival, length, gain and corners.

    With `diffuse` these are the paths that are scattered somewhere, otherwise all others.
    """
    paths = sionna().PathSolver(deterministic=True)(
        held,
        max_depth=tracing.order,
        samples_per_src=rays,
        los=not diffuse,
        specular_reflection=True,
        diffuse_reflection=diffuse,
        refraction=False,
        diffraction=tracing.diffraction and not diffuse,
        seed=tracing.seed,
    )
    kept = paths.valid.numpy()[:, 0]
    kind = np.zeros((*kept.shape, tracing.order), dtype=np.int64)
    depth = len(paths.interactions.numpy()) if kind.size else 0  # that of the deepest path
    if depth:
        kind[..., :depth] = np.moveaxis(paths.interactions.numpy()[:, :, 0], 0, -1)
    if diffuse:
        kept &= (kind == DIFFUSE).any(axis=-1)
    owner, path = np.nonzero(kept)
    corner = np.full((len(owner), tracing.order, 3), np.nan)
    if depth:
        corner[:, :depth] = np.moveaxis(paths.vertices.numpy()[:, :, 0], 0, -2)[owner, path]
    corner[kind[owner, path] == 0] = np.nan

    def chosen(values: Any) -> NDArray[np.float64]:
        found: NDArray[np.float64] = values.numpy()[:, 0][owner, path].astype(np.float64)
        return found

    def direction(zenith: Any, azimuth: Any) -> NDArray[np.float64]:
        return to_direction(torch.from_numpy(chosen(azimuth)), math.pi / 2 - torch.from_numpy(chosen(zenith))).numpy()

    real, imaginary = (part.numpy()[:, 0, 0, 0] for part in paths.a)
    table = {
        "owner": owner,
        "length": chosen(paths.tau) * LIGHT_SPEED,
        "gain": (real + 1j * imaginary)[owner, path].astype(np.complex128),
        "corner": corner,
        "departure": direction(paths.theta_t, paths.phi_t),
        "arrival": direction(paths.theta_r, paths.phi_r),
    }
    return table if diffuse else {name: values[_first(table)] for name, values in table.items()}


def _first(table: Table) -> NDArray[np.int64]:
    """Return the rows that do not repeat an earlier path of their position; adjacent triangles may find one twice."""
    image = table["length"][:, None] * table["arrival"]
    rows = [
        mine[~np.tril(np.linalg.norm(image[mine][:, None] - image[mine], axis=-1) < SAME_IMAGE_M, -1).any(axis=1)]
        for mine in (np.flatnonzero(table["owner"] == number) for number in np.unique(table["owner"]))
    ]
    return np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)
