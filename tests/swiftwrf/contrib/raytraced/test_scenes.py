"""Ray-traced scenes: the geometry against image sources, gains against Fresnel's equations, files, and refusals.

What needs Sionna RT is skipped where it, or LLVM, is missing.
"""

import cmath
import json
import math
import re
import sys
from contextlib import nullcontext
from dataclasses import replace
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from quick import run, said

from swiftwrf import AngularGrid, GeometryModel, InputError, load_spectra, load_stations, simulated_room
from swiftwrf.array.planar import LIGHT_SPEED
from swiftwrf.contrib.raytraced import ROOMS, FurnishedRoom, Material, Scene, Surface, Tracing, sionna, trace
from swiftwrf.contrib.raytraced.model import RaytraceModel, surfaces
from swiftwrf.contrib.raytraced.rooms import box
from swiftwrf.contrib.raytraced.trace import _first
from swiftwrf.data.simulated import ShoeboxRoom
from swiftwrf.models.geometry import Plane
from tasks.scenes import draw_positions

FREQUENCY = 2.4e9
WAVELENGTH = LIGHT_SPEED / FREQUENCY
SIZE = (6.0, 5.0, 3.0)
FIXED = torch.tensor([3.1, 2.4, 2.6], dtype=torch.float64)
EDGE_M = 0.01  # Sionna loses paths that pass an edge this closely
OPTIONS = ("--room", "bedroom", "--moving", "receiver", "--positions", 5)
ENDS = (*OPTIONS[2:], "--fixed", 0, 0, 1, "--region", 0, 0, 0, 1, 1, 1)


def empty(material: str) -> FurnishedRoom:
    return FurnishedRoom(SIZE, material, material, material, (), (3.1, 2.4, 2.6), ((1, 1, 0.8), (5, 4, 1.9)))


def places(count: int, seed: int = 0) -> torch.Tensor:
    return draw_positions(None, torch.tensor(((1, 1, 0.8), (5, 4, 1.9)), dtype=torch.float64), count, seed)


def ends(position, moving):
    """Transmitters and receivers."""
    pair = (position, FIXED.expand_as(position))
    return pair if moving == "transmitter" else pair[::-1]


# the rooms, without a ray


@pytest.mark.parametrize("name", list(ROOMS))
def test_furniture_stands_in_the_room_and_leaves_the_ends_free(name):
    room = ROOMS[name]
    for _, *corners in room.furniture:
        low, high = torch.tensor(corners, dtype=torch.float64)
        assert bool(((low >= 0) & (low < high) & (high <= torch.tensor(room.size, dtype=torch.float64))).all())
        assert not room.free((low + high)[None] / 2)
    assert room.free(torch.tensor([room.fixed], dtype=torch.float64))
    assert not room.free(torch.tensor([[-1.0, 1, 1]], dtype=torch.float64))
    drawn = draw_positions(room, torch.tensor(room.region, dtype=torch.float64), 200, 0)
    assert room.free(drawn).all()
    assert torch.equal(drawn, draw_positions(room, torch.tensor(room.region, dtype=torch.float64), 200, 0))


def test_a_box_is_closed_and_turned_outwards():
    vertex, triangle = box((1, 2, 3), (2, 4, 6))
    corner = vertex[triangle]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2
    assert ((corner.mean(axis=1) - [1.5, 3, 4.5]) * normal).sum(axis=1).min() > 0
    assert np.linalg.norm(normal, axis=1).sum() == pytest.approx(2 * (2 + 3 + 6))


# the physics


@pytest.mark.parametrize("moving", ["transmitter", "receiver"])
def test_the_direct_path_is_that_of_free_space(ray_tracer, moving):
    position = places(9)
    paths = trace(Scene([], FREQUENCY), FIXED, position, moving, Tracing(order=0))
    transmitter, receiver = ends(position, moving)
    away = transmitter - receiver
    distance = away.norm(dim=1)
    assert paths.count.tolist() == [1] * 9
    assert paths.line_of_sight.all()
    torch.testing.assert_close(paths.length, distance, rtol=1e-6, atol=0)
    torch.testing.assert_close(paths.direction, away / distance[:, None], rtol=0, atol=1e-6)
    amplitude = WAVELENGTH / (4 * math.pi * distance)
    expected = torch.polar(amplitude, -2 * math.pi / WAVELENGTH * distance)
    torch.testing.assert_close(paths.gain / amplitude, expected / amplitude, rtol=0, atol=1e-3)
    assert torch.equal(paths.last_point(), transmitter)


@pytest.mark.parametrize("moving", ["transmitter", "receiver"])
def test_a_metal_box_has_the_image_sources_of_the_simulated_room(ray_tracer, moving):
    """For vertical isotropic ends a perfect conductor reflects -1 at walls and +1 at floor and ceiling, at any angle. The
    metal of ITU-R P.2040 conducts less: its gains are up to 2e-3 lower after two reflections."""
    position = places(40)
    paths = trace(Scene(empty("metal").surfaces(), FREQUENCY), FIXED, position, moving, Tracing(order=2))
    transmitter, receiver = ends(position, moving)
    image = ShoeboxRoom(SIZE, (), reflection=1.0, frequency_hz=FREQUENCY).paths(transmitter, receiver)
    gain, length, direction = (
        t.reshape(len(position), 25, *t.shape[1:]) for t in (image.gain, image.length, image.direction)
    )
    source = direction * length[..., None]
    found = 0
    for number in range(len(position)):
        mine = paths.owner == number
        apart, which = torch.cdist(source[number], paths.direction[mine] * paths.length[mine, None]).min(dim=1)
        seen = apart < 1e-3 * length[number]
        for missed in source[number][~seen]:
            assert passes_an_edge(receiver[number], missed)
        which = which[seen]
        assert len(which.unique()) == len(which) == int(mine.sum())
        found += len(which)
        torch.testing.assert_close(paths.length[mine][which], length[number][seen], rtol=1e-4, atol=0)
        torch.testing.assert_close(paths.direction[mine][which], direction[number][seen], rtol=0, atol=1e-3)
        corner = paths.corner[mine][which]
        walls = ((corner[..., 2] > 1e-3) & (corner[..., 2] < SIZE[2] - 1e-3)).sum(dim=1)
        ratio = paths.gain[mine][which] / gain[number][seen] * (-1.0) ** walls
        torch.testing.assert_close(ratio, torch.ones_like(ratio), rtol=0, atol=2e-3)
        last = paths.last_point()[mine][which] - receiver[number]
        torch.testing.assert_close(
            last / last.norm(dim=1, keepdim=True), paths.direction[mine][which], rtol=0, atol=1e-3
        )
    assert found > 0.99 * 25 * len(position)


def passes_an_edge(receiver: torch.Tensor, source: torch.Tensor) -> bool:
    """Return True if the straight line to an image source leaves the room within a centimetre of an edge."""
    crossing = sorted(
        ((wall - float(receiver[axis])) / float(source[axis]), axis)
        for axis in range(3)
        for wall in (0.0, SIZE[axis])
        if 0 < (wall - float(receiver[axis])) / float(source[axis]) < 1
    )
    (first, _), (second, axis) = crossing
    return (second - first) * abs(float(source[axis])) < EDGE_M


def test_a_concrete_wall_reflects_as_fresnel_says(ray_tracer):
    """At normal incidence, a slab of ITU-R P.2040's concrete; the image-source room has one number for all."""
    fixed, position = torch.tensor([3.0, 2.5, 1.5]).double(), torch.tensor([[4.0, 2.5, 1.5]]).double()
    paths = trace(Scene(empty("concrete").surfaces(), FREQUENCY), fixed, position, "receiver", Tracing(order=1))
    row = int((paths.length - 7).abs().argmin())  # by way of the wall x = 0
    assert float(paths.length[row]) == pytest.approx(7, abs=1e-5)
    ratio = complex(paths.gain[row]) / (WAVELENGTH / (4 * math.pi * 7) * cmath.exp(-2j * math.pi * 7 / WAVELENGTH))
    ghz, vacuum = FREQUENCY / 1e9, 8.8541878e-12
    eta = 5.24 - 1j * 0.0462 * ghz**0.7822 / (2 * math.pi * FREQUENCY * vacuum)
    single = (1 - cmath.sqrt(eta)) / (1 + cmath.sqrt(eta))
    through = cmath.exp(-4j * math.pi * 0.2 / WAVELENGTH * cmath.sqrt(eta))
    slab = single * (1 - through) / (1 - single**2 * through)
    assert abs(ratio - slab) < 2e-3
    assert 0.3 < abs(slab) < 0.5  # the simulated room's walls reflect 0.6


def test_furniture_blocks_scatters_and_diffracts(ray_tracer):
    wall = Surface.joined("block", Material("metal", 0.001), [box((2.5, 0, 0), (3.5, 3.0, 2.9))])
    surfaces = [*empty("metal").surfaces(), wall]
    fixed, position = torch.tensor([2.0, 1.0, 1.5]).double(), torch.tensor([[3.2, 4.0, 1.5], [1.5, 4.0, 1.0]]).double()
    plain = trace(Scene(surfaces, FREQUENCY), fixed, position, "receiver", Tracing(order=2))
    assert plain.line_of_sight.tolist() == [False, True]
    bent = trace(Scene(surfaces, FREQUENCY), fixed, position, "receiver", Tracing(order=1, diffraction=True))
    assert (bent.order <= 1).all()
    assert bent.count[0] > (plain.order[plain.owner == 0] <= 1).sum()  # round the corner
    how = Tracing(order=1, scattering=True)
    rough = trace(Scene(surfaces, FREQUENCY, 0.6), fixed, position, "receiver", how)
    smooth = trace(Scene(surfaces, FREQUENCY), fixed, position, "receiver", Tracing(order=1))
    assert (rough.count > smooth.count + 20).all()
    mirror = [p.gain[(p.owner == 1) & (p.order == 1)].abs().max() for p in (rough, smooth)]
    assert float(mirror[0] / mirror[1]) == pytest.approx(math.sqrt(1 - 0.6**2), abs=1e-3)
    again = trace(Scene(surfaces, FREQUENCY, 0.6), fixed, position, "receiver", how)
    assert torch.equal(rough.gain, again.gain)
    other = trace(Scene(surfaces, FREQUENCY, 0.6), fixed, position, "receiver", replace(how, seed=1))
    assert not torch.equal(rough.gain, other.gain)


def test_both_mobilities_see_the_same_paths(ray_tracer):
    room = ROOMS["bedroom"]
    scene = Scene(room.surfaces(), FREQUENCY)
    fixed, region = (torch.tensor(x, dtype=torch.float64) for x in (room.fixed, room.region))
    position = draw_positions(room, region, 3, 0)
    there, back = (trace(scene, fixed, position, moving, Tracing()) for moving in ("receiver", "transmitter"))
    assert torch.equal(there.gain, back.gain)
    transmitters = fixed.expand_as(position)
    first = torch.where(there.order[:, None] > 0, there.corner[:, 0], position[there.owner]) - transmitters[there.owner]
    torch.testing.assert_close(first / first.norm(dim=1, keepdim=True), back.direction, rtol=0, atol=1e-4)


def test_a_path_that_two_triangles_find_counts_once():
    """Paths of equal length, direction and position have one image source."""
    arrival = np.array([[1.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 0, 0]])
    table = {"owner": np.array([0, 0, 0, 0, 1]), "length": np.array([2, 2 + 1e-5, 2, 3, 2]), "arrival": arrival}
    assert _first(table).tolist() == [0, 2, 3, 4]


# the command


@pytest.mark.parametrize("moving", ["transmitter", "receiver"])
def test_a_scene_is_read_back_as_spectra(ray_tracer, tmp_path, moving):
    assert run("scenes", "--room", "bedroom", "--moving", moving, "--positions", 6, "--out", tmp_path / "scene") == 0
    data = load_spectra(tmp_path / "scene", grid=AngularGrid.hemisphere(15, 60))
    room = ROOMS["bedroom"]
    assert (len(data), data.moving, data.fixed_position.tolist()) == (6, moving, list(room.fixed))
    assert data.array.frequency_hz == pytest.approx(FREQUENCY)
    assert room.free(data.position).all()
    record = json.loads((tmp_path / "scene" / "scene.json").read_text())
    assert record["positions"] == 6
    assert record["surfaces"]["walls"] == "brick"
    assert record["line_of_sight"] == int(data.line_of_sight.sum())
    assert "<svg" in (tmp_path / "scene" / "scene.svg").read_text()


def test_several_fixed_ends_are_stations(ray_tracer, tmp_path):
    ends = ((0.3, 0.3, 2.2), (3.9, 0.3, 2.2))
    options = ("--room", "bedroom", "--moving", "transmitter", "--positions", 5, "--fixed", *ends[0], *ends[1])
    assert run("scenes", *options, "--out", tmp_path / "scene") == 0
    found = load_stations(tmp_path / "scene", grid=AngularGrid.hemisphere(15, 60))
    assert found.names == ["array1", "array2"]
    assert len(found) == 5
    for name, end in zip(found.names, ends, strict=True):
        assert found.of(name)[1].fixed_position.tolist() == list(end)


def test_a_scene_file_is_traced_as_the_room_that_it_describes(ray_tracer, tmp_path):
    file = write_scene(tmp_path, "concrete")
    read = trace(Scene(file, FREQUENCY), FIXED, places(4), "receiver", Tracing())
    built = trace(Scene(empty("concrete").surfaces(), FREQUENCY), FIXED, places(4), "receiver", Tracing())
    torch.testing.assert_close(read.length, built.length, rtol=1e-5, atol=0)
    torch.testing.assert_close(read.gain.abs(), built.gain.abs(), rtol=1e-2, atol=1e-7)
    options = ("--moving", "transmitter", "--positions", 3, "--fixed", *FIXED.tolist())
    options += ("--region", 1, 1, 0.8, 5, 4, 1.9)
    assert run("scenes", "--room", file, *options, "--out", tmp_path / "out") == 0
    assert len(load_spectra(tmp_path / "out", grid=AngularGrid.hemisphere(15, 60))) == 3


def write_scene(folder, material):
    """The empty room as a Mitsuba scene with a mesh in PLY."""
    vertex, triangle = box((0, 0, 0), SIZE)
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertex)}", *(f"property float {a}" for a in "xyz")]
    lines += [f"element face {len(triangle)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(map(str, row)) for row in vertex.tolist()]
    lines += [" ".join(map(str, (3, *row))) for row in triangle.tolist()]
    (folder / "room.ply").write_text("\n".join(lines) + "\n")
    bsdf = f'<bsdf type="itu-radio-material" id="wall"><string name="type" value="{material}"/>'
    bsdf += '<float name="thickness" value="0.2"/></bsdf>'
    shape = '<shape type="ply" id="room"><string name="filename" value="room.ply"/><ref id="wall" name="bsdf"/></shape>'
    (folder / "room.xml").write_text(f'<scene version="2.1.0">{bsdf}{shape}</scene>')
    return folder / "room.xml"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((*OPTIONS, "--frequency", 9e8), "ITU-R P.2040 knows plasterboard at"),
        (("--room", "{folder}/junk.xml", *ENDS), "not a scene"),
        (("--room", "{folder}/empty.xml", *ENDS), "not a scene"),
        (("--room", "{folder}/rectangle.xml", *ENDS), "a scene of meshes"),
        (("--room", "{folder}/room.xml", *OPTIONS[2:], "--fixed", 0, 0, 9, "--region", 1, 1, 1, 2, 2, 2), "no path"),
    ],
)
def test_what_only_sionna_knows_is_refused(ray_tracer, tmp_path, capsys, arguments, says):
    write_scene(tmp_path, "concrete")
    (tmp_path / "junk.xml").write_text("junk")
    (tmp_path / "empty.xml").write_text("<scene/>")
    room = (tmp_path / "room.xml").read_text()
    (tmp_path / "rectangle.xml").write_text(re.sub("<shape.*</shape>", '<shape type="rectangle" id="floor"/>', room))
    before = sorted(tmp_path.iterdir())
    arguments = [str(a).replace("{folder}", str(tmp_path)) for a in arguments]
    assert run("scenes", *arguments, "--out", tmp_path / "out") == 2
    assert says in said(capsys)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("material", "says"), [("floorboard", "choose another --frequency"), ("cheese", "'cheese' is no material")]
)
def test_materials_that_cannot_be_traced(ray_tracer, material, says):
    with pytest.raises(InputError, match=says):
        Scene(empty(material).surfaces(), FREQUENCY)


def test_a_plan_of_a_room_has_its_walls_furniture_and_ends():
    scene, room = Scene.__new__(Scene), ROOMS["bedroom"]
    scene.surfaces = room.surfaces()
    region = torch.tensor(room.region, dtype=torch.float64)
    ax = scene.plot(torch.tensor(room.fixed), draw_positions(room, region, 9, 0))
    assert {"brick", "wood", "fixed end", "moving end"} <= set(ax.get_legend_handles_labels()[1])
    walls = np.concatenate([line.get_xydata() for line in ax.lines])
    np.testing.assert_allclose([np.nanmin(walls, axis=0), np.nanmax(walls, axis=0)], [(0, 0), room.size[:2]], atol=1e-9)
    assert ax.patches  # furniture is filled


# refusals that need no Sionna


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--room", "kitchen", *OPTIONS[2:]), "unknown room 'kitchen'; choose from conference, office, bedroom"),
        (("--room", "none.xml", *OPTIONS[2:]), "none.xml does not exist"),
        ((*OPTIONS[:4], "--positions", 1), "--positions must be a whole number at least 2"),
        ((*OPTIONS, "--frequency", 2.4), "--frequency must be a number at least 1000000.0"),
        ((*OPTIONS, "--order", 9), "--order must be a whole number at least 0 and at most 8"),
        ((*OPTIONS, "--order", 0, "--diffraction"), "need at least --order 1"),
        ((*OPTIONS, "--scattering", 1.1), "--scattering must be a number at least 0 and at most 1"),
        ((*OPTIONS, "--fixed", 5, 1), "--fixed takes x y z of each fixed end, got 2 numbers"),
        ((*OPTIONS, "--fixed", 5, 1, 1), "--fixed 5 1 1 is outside the room of 4.2 x 3.6 x 2.5 m"),
        ((*OPTIONS, "--fixed", 2, 1, 0.4), "in furniture"),
        ((*OPTIONS, "--region", 1, 1, 1, 2, 2, 9), "is not inside the room"),
        ((*OPTIONS, "--region", 1.5, 0.5, 0.1, 2.5, 1.5, 0.4), "only 0 of 5 positions are free"),
        (("--room", "{file}.xml", *OPTIONS[2:]), "does not contain the positions of the ends"),
        (OPTIONS, "pip install 'swiftwrf-tasks[raytrace]'"),
    ],
)
def test_what_cannot_be_is_refused_without_sionna(tmp_path, capsys, monkeypatch, arguments, says):
    monkeypatch.setitem(sys.modules, "drjit", None)
    (tmp_path / "file.xml").write_text("<scene/>")
    arguments = [str(a).replace("{file}", str(tmp_path / "file")) for a in arguments]
    assert run("scenes", *arguments, "--out", tmp_path / "out") == 2
    assert says in said(capsys)
    assert [file.name for file in tmp_path.iterdir()] == ["file.xml"]


@pytest.mark.parametrize(
    ("variant", "version", "refused"), [("llvm_ad", 15, True), ("cuda_ad", 15, False), ("llvm_ad", 19, False)]
)
def test_an_llvm_that_would_abort_the_process_is_refused(monkeypatch, variant, version, refused):
    drjit = SimpleNamespace(detail=SimpleNamespace(llvm_version=lambda: (version, 0, 6)), set_thread_count=int)
    monkeypatch.setitem(sys.modules, "drjit", drjit)
    monkeypatch.setitem(sys.modules, "mitsuba", SimpleNamespace(variant=lambda: variant))
    monkeypatch.setitem(sys.modules, "sionna", SimpleNamespace(rt="the module"))
    monkeypatch.setitem(sys.modules, "sionna.rt", "the module")
    with pytest.raises(InputError, match=r"got LLVM 15; .*libllvm19") if refused else nullcontext():
        assert sionna() == "the module"


def test_a_missing_llvm_is_named(tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "sionna"]:
        monkeypatch.delitem(sys.modules, name)
    (tmp_path / "sionna.py").write_text("raise ImportError('the LLVM shared library could not be found')")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("drjit", "mitsuba"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    with pytest.raises(InputError, match=r"apt-get install libllvm19.*DRJIT_LIBLLVM_PATH"):
        sionna()


def test_the_synthesizer_is_refused_before_anything_is_computed(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "drjit", None)
    assert run("aoa", "--mix", 0.5, "--synthesizer", "raytrace", "--out", tmp_path / "out") == 2
    assert "swiftwrf-tasks[raytrace]" in said(capsys)
    assert not list(tmp_path.iterdir())


# the synthesizer


def test_the_synthesizer_draws_the_spectra_of_its_scene(ray_tracer, tmp_path):
    """Traced twice, once as data and once from the scene's name, they are the same; so is the moving array, turned."""
    run("scenes", *OPTIONS[:4], "--positions", 12, "--out", tmp_path / "scene")
    data = load_spectra(tmp_path / "scene", grid=AngularGrid.hemisphere(15, 60))
    model = RaytraceModel(scene="bedroom").fit(data)
    torch.testing.assert_close(model.synthesize(data.position), data.spectrum, rtol=0, atol=2e-3)
    outside = torch.tensor([[50.0, 0, 0], [1e9, 0, 0]], dtype=torch.float64)
    assert not model.synthesize(outside).any()
    again = RaytraceModel.from_state(*model.state())
    torch.testing.assert_close(again.synthesize(data.position), model.synthesize(data.position))


def test_planes_of_a_found_room_reflect_as_strongly_as_the_spectra_say(ray_tracer):
    data = simulated_room(n=4, grid=AngularGrid.hemisphere(15, 60))
    wall = Plane(normal=(1.0, 0.0, 0.0), offset_m=6.0, gain=-0.6, std_mm=1.0)
    made = surfaces(GeometryModel.of_planes(data, [wall]))
    scene = Scene(made, data.array.frequency_hz)
    position = data.fixed_position + torch.tensor([[2.0, 0, 0]], dtype=torch.float64)
    relative = position - data.fixed_position
    paths = trace(scene, torch.zeros(3, dtype=torch.float64), relative, "transmitter", Tracing())
    assert paths.count.tolist() == [2]
    assert paths.length.tolist() == pytest.approx([2.0, 2 * (6.0 - float(data.fixed_position[0])) - 2.0], rel=1e-5)
    assert float(paths.gain[1].abs() * paths.length[1] / paths.gain[0].abs() / 2) == pytest.approx(0.6, abs=5e-3)
