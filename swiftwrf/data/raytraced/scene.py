"""A scene in Sionna RT: made of surfaces, or read from a Mitsuba file. Sionna is imported here, when it is needed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from swiftwrf.choices import SCENE_FILE, check_scene
from swiftwrf.data.raytraced.rooms import ROOMS
from swiftwrf.data.raytraced.surfaces import Material, Surface
from swiftwrf.errors import InputError

MIN_LLVM = 19  # earlier ones abort the process when they compile a trace; tried: 15 and 16
ISOTROPIC = {"num_rows": 1, "num_cols": 1, "pattern": "iso", "polarization": "V"}


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
    version = drjit.detail.llvm_version()[0] if mitsuba.variant().startswith("llvm") else MIN_LLVM
    if version < MIN_LLVM:
        raise InputError(f"Sionna RT needs LLVM {MIN_LLVM} without an NVIDIA GPU, got LLVM {version}; {remedy}")
    drjit.set_thread_count(torch.get_num_threads())
    return sionna.rt


class Scene:
    """Surfaces at a carrier frequency, ready to be traced.

    Args:
        surfaces: Surfaces of the scene.
        frequency_hz: Frequency of the carrier [Hz].
        scattering: Scattering coefficient of all materials, the fraction of the reflected amplitude that is scattered.

    Raises:
        InputError: Sionna RT or LLVM is missing, or a material is unknown or has no constants at the carrier.
    """

    def __init__(self, surfaces: Sequence[Surface], frequency_hz: float, scattering: float = 0.0) -> None:
        self.held = _at(sionna().load_scene(), frequency_hz)
        self.surfaces = list(surfaces)
        materials = {surface.material: _material(surface.material) for surface in surfaces}
        try:
            self.held.edit(add=[_object(surface, materials[surface.material]) for surface in surfaces])
        except ValueError as error:
            raise InputError(_reason(surfaces, frequency_hz, error)) from None
        self._scatter(scattering)

    @classmethod
    def read(cls, file: Path, frequency_hz: float, scattering: float = 0.0) -> Scene:
        """Return the scene in a Mitsuba XML file, with the radio materials that it names.

        Raises:
            InputError: As the constructor, no such file, or a file that is no scene with objects.
        """
        if not file.is_file():
            raise InputError(f"{file} does not exist; expected a Mitsuba scene (XML) or the name of a room")
        rt, scene = sionna(), cls.__new__(cls)
        try:
            held = rt.load_scene(str(file))
        except Exception as error:  # parsers of XML, meshes and materials raise exceptions of their own
            raise InputError(f"{file} is no scene that Sionna RT reads ({error})") from None
        if not held.objects:
            raise InputError(f"{file} is a scene without objects; there is nothing to trace")
        try:
            scene.held = _at(held, frequency_hz)
        except ValueError as error:
            raise InputError(f"{file} has a material without constants at {frequency_hz:g} Hz ({error})") from None
        scene._scatter(scattering)
        scene.surfaces = [_surface(name, thing) for name, thing in held.objects.items()]
        return scene

    def _scatter(self, coefficient: float) -> None:
        for material in self.held.radio_materials.values():
            material.scattering_coefficient = coefficient


def open_scene(name: str, frequency_hz: float) -> Scene:
    """Return the scene of a built-in room, or of a file, at a carrier frequency [Hz].

    Raises:
        InputError: As `Scene`, or an unknown room.
    """
    check_scene(name)
    return (
        Scene.read(Path(name), frequency_hz)
        if name.endswith(SCENE_FILE)
        else Scene(ROOMS[name].surfaces(), frequency_hz)
    )


def _at(held: Any, frequency_hz: float) -> Any:
    held.frequency = frequency_hz
    held.tx_array = held.rx_array = sionna().PlanarArray(**ISOTROPIC)
    return held


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
