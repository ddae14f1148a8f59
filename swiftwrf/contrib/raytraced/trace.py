"""Propagation paths between a fixed end and positions of the moving one, by Sionna RT.

Rays are launched from the fixed end and reflected; the image method makes the chains of surfaces that they find exact (J.
Hoydis et al., "Sionna RT: Differentiable Ray Tracing for Radio Propagation Modeling", 2023). Both ends are isotropic and
vertically polarised, so paths are reciprocal, and a moving transmitter is traced from the receiver. Sionna's coefficient is
that of the passband; the phase of the whole length, -2 pi f delay, is added here. Obstacles block, without transmission.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.array.angles import to_direction
from swiftwrf.array.planar import LIGHT_SPEED
from swiftwrf.choices import Moving
from swiftwrf.contrib.raytraced.names import SCENE_FILE, check_scene
from swiftwrf.contrib.raytraced.rooms import ROOMS, Material, Surface
from swiftwrf.data.archives import refusing_broken
from swiftwrf.data.paths import PropagationPaths
from swiftwrf.errors import InputError
from swiftwrf.plotting import MARK, Axes, plan_axes
from swiftwrf.runtime.progress import progress_bar
from swiftwrf.runtime.validation import NonNegativeInt, configuration

BATCH_POSITIONS = 32  # chains share a table, which many positions would fill
Table = dict[str, NDArray[Any]]
MIN_LLVM = 19  # earlier ones abort the process when they compile a trace; tried: 15 and 16
LEVEL_COSINE = 0.5  # of a normal to the vertical; faces above are level
SHELL_EXTENT = 0.95  # of the scene; floors, ceilings and walls of that size are not filled in a plan
MOVING = "#444444"


def sionna() -> Any:
    """Return the module `sionna.rt`.

    Raises:
        InputError: It is not installed, or finds neither a GPU nor LLVM, or an LLVM whose compilation aborts Python.
    """
    remedy = f"install it (apt-get install libllvm{MIN_LLVM}) and let DRJIT_LIBLLVM_PATH name its libLLVM.so"
    try:
        import drjit
        import mitsuba
        import sionna.rt
    except ImportError as error:
        if "LLVM" in str(error):
            raise InputError(f"Sionna RT finds no LLVM, which it needs without an NVIDIA GPU; {remedy}") from None
        raise InputError(
            "ray tracing needs Sionna RT; install it with pip install 'swiftwrf-tasks[raytrace]'"
        ) from None
    version = drjit.detail.llvm_version()[0] if str(mitsuba.variant()).startswith("llvm") else MIN_LLVM
    if version < MIN_LLVM:
        raise InputError(f"Sionna RT needs LLVM {MIN_LLVM} without an NVIDIA GPU, got LLVM {version}; {remedy}")
    drjit.set_thread_count(torch.get_num_threads())
    return sionna.rt


class Scene:
    """Surfaces at a carrier frequency, ready to be traced.

    Args:
        content: Surfaces of the scene, or a Mitsuba XML file that names their radio materials.
        frequency_hz: Frequency of the carrier [Hz].
        scattering: Scattering coefficient of all materials, the fraction of the reflected amplitude that is scattered.

    Raises:
        InputError: Sionna RT or LLVM is missing, a material is unknown or has no constants at the carrier, or a file is
            missing or no scene with objects.
    """

    def __init__(self, content: Sequence[Surface] | Path, frequency_hz: float, scattering: float = 0.0) -> None:
        file = content if isinstance(content, Path) else None
        if file is not None and not file.is_file():
            raise InputError(f"{file} does not exist; expected a Mitsuba scene (XML) or the name of a room")
        rt = sionna()
        with refusing_broken(file, "a scene of meshes that Sionna RT reads"):
            self.held = rt.load_scene() if file is None else rt.load_scene(str(file))
            held = [_surface(name, thing) for name, thing in self.held.objects.items()]
        if file is not None and not held:
            raise InputError(f"{file} is a scene without objects; there is nothing to trace")
        surfaces = [] if isinstance(content, Path) else list(content)
        materials = {surface.material: _material(surface.material) for surface in surfaces}
        try:
            self.held.frequency = frequency_hz
            self.held.edit(add=[_object(surface, materials[surface.material]) for surface in surfaces])
        except ValueError as error:
            reason = f"{file} has a material without constants at {frequency_hz:g} Hz ({error})"
            raise InputError(_reason(surfaces, frequency_hz, error) if file is None else reason) from None
        self.held.tx_array = self.held.rx_array = rt.PlanarArray(
            num_rows=1, num_cols=1, pattern="iso", polarization="V"
        )
        for material in self.held.radio_materials.values():
            material.scattering_coefficient = scattering
        self.surfaces = surfaces or held

    def plot(self, fixed: Tensor | None = None, position: Tensor | None = None, ax: Axes | None = None) -> Axes:
        """Draw the surfaces seen from above by material, fixed ends (..., 3) and positions (n, 3) of the moving one."""
        ax = plan_axes(ax)
        every = np.concatenate([surface.vertex[:, :2] for surface in self.surfaces])
        materials = list(dict.fromkeys(surface.material.name for surface in self.surfaces))
        for surface in self.surfaces:
            name, face = surface.material.name, surface.vertex[surface.triangle]
            normal = np.cross(face[:, 1] - face[:, 0], face[:, 2] - face[:, 0])
            is_level = np.abs(normal[:, 2]) > LEVEL_COSINE * np.linalg.norm(normal, axis=1)
            is_shell = bool((np.ptp(surface.vertex[:, :2], axis=0) > SHELL_EXTENT * np.ptp(every, axis=0)).all())
            colour = f"C{materials.index(name) % 10}"
            outline, filled = face[~is_level, :, :2], face[is_level & (not is_shell), :, :2]
            width = 2.0 if is_shell else 0.8
            ax.plot(*outline[:, [0, 1, 2, 0]].T, color=colour, linewidth=width)
            for triangle in filled:
                ax.fill(*triangle.T, color=colour, alpha=0.2, linewidth=0)
            if len(outline) or len(filled):
                shown = ax.get_legend_handles_labels()[1]
                ax.plot([], [], color=colour, label=None if name in shown else name)
        if position is not None:
            ax.plot(*position[:, :2].T.numpy(), ".", color=MOVING, markersize=2.5, label="moving end")
        if fixed is not None:
            ax.plot(
                *fixed[..., :2].reshape(-1, 2).T.numpy(),
                "*",
                color=MARK,
                markersize=12,
                label="fixed end",
                linestyle="",
            )
        ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1))
        return ax


def open_scene(name: str, frequency_hz: float, scattering: float = 0.0) -> Scene:
    """Return the scene of a built-in room, or of a file, at a carrier frequency [Hz].

    Raises:
        InputError: As `Scene`, or an unknown room.
    """
    check_scene(name)
    return Scene(Path(name) if name.endswith(SCENE_FILE) else ROOMS[name].surfaces(), frequency_hz, scattering)


def _material(material: Material) -> Any:
    rt, name = sionna(), f"material-{material.name}"  # names of materials and objects must differ
    if material.relative_permittivity is not None:
        return rt.RadioMaterial(
            name,
            thickness=material.thickness_m,
            relative_permittivity=material.relative_permittivity,
            conductivity=material.conductivity,
        )
    try:
        return rt.ITURadioMaterial(name, material.name, material.thickness_m)
    except ValueError:
        known = ", ".join(_itu_materials())
        raise InputError(f"{material.name!r} is no material of ITU-R P.2040; choose from {known}") from None


def _itu_materials() -> dict[str, dict[tuple[float, float], Any]]:
    """Return the materials of ITU-R P.2040 with their ranges of carriers [GHz]."""
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

    table: dict[str, dict[tuple[float, float], Any]] = ITU_MATERIALS_PROPERTIES
    return table


def _reason(surfaces: Sequence[Surface], frequency_hz: float, error: ValueError) -> str:
    """Return the material that has no constants at the carrier, and the carriers at which it has."""
    for name in dict.fromkeys(surface.material.name for surface in surfaces):
        ranges = list(_itu_materials().get(name, ()))
        if ranges and not any(low <= frequency_hz / 1e9 <= high for low, high in ranges):
            known = ", ".join(f"{low:g} to {high:g}" for low, high in sorted(ranges))
            return f"ITU-R P.2040 knows {name} at {known} GHz, not at {frequency_hz / 1e9:g} GHz; choose another --frequency"
    return f"Sionna RT refuses the scene ({error})"


def _object(surface: Surface, material: Any) -> Any:
    import mitsuba

    mesh = mitsuba.Mesh(surface.name, len(surface.vertex), len(surface.triangle))
    content = mitsuba.traverse(mesh)
    content["vertex_positions"] = surface.vertex.astype(np.float32).ravel()
    content["faces"] = surface.triangle.astype(np.uint32).ravel()
    content.update()
    return sionna().SceneObject(mi_mesh=mesh, name=surface.name, radio_material=material)


def _surface(name: str, thing: Any) -> Surface:
    """Return the surface of an object that Sionna read."""
    import mitsuba

    content = mitsuba.traverse(thing.mi_mesh)
    vertex = np.array(content["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    triangle = np.array(content["faces"], dtype=np.int64).reshape(-1, 3)
    material = thing.radio_material
    return Surface(name, Material(material.name, float(np.array(material.thickness).item())), vertex, triangle)


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
    """Return all paths between the fixed end (3,) [m] and each position (n, 3) [m] of the moving one, shortest first."""
    found: list[PropagationPaths] = []
    with progress_bar(progress) as bar:
        task = bar.add_task("positions traced", total=len(position))
        for some in position.split(BATCH_POSITIONS):
            found.append(_trace_batch(scene.held, fixed.double(), some.double(), moving, tracing))
            bar.advance(task, len(some))
    return PropagationPaths.joined(found)


def _trace_batch(held: Any, fixed: Tensor, position: Tensor, moving: Moving, tracing: Tracing) -> PropagationPaths:
    rt = sionna()
    for name in (*held.transmitters, *held.receivers):
        held.remove(name)
    held.add(rt.Transmitter("fixed", fixed.tolist()))  # wherever the transmitter is, as paths are reciprocal
    for number, place in enumerate(position.tolist()):
        held.add(rt.Receiver(f"moving-{number}", place))
    tables = [_solve(held, tracing, 30_000, diffuse=False)]  # search for chains
    if tracing.scattering:
        tables.append(_solve(held, tracing, 300, diffuse=True))  # each is a path wherever it scatters
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
        kept &= (kind == 2).any(axis=-1)  # scatterings
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
        mine[~np.tril(np.linalg.norm(image[mine][:, None] - image[mine], axis=-1) < 1e-3, -1).any(axis=1)]
        for mine in (np.flatnonzero(table["owner"] == number) for number in np.unique(table["owner"]))
    ]
    return np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)
