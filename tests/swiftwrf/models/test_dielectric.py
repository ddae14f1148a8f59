"""Gains that depend on the angle of incidence: Fresnel's equations, and rooms of dielectrics that channels show."""

from dataclasses import replace

import pytest
import torch
from rooms import built_in_walls, mirror_room
from small import GLANCE

from swiftwrf import Spectra
from swiftwrf.data.splits import folds
from swiftwrf.data.store import Store
from swiftwrf.models.geometry import GeometryConfig, GeometryModel, Plane, furniture
from swiftwrf.models.geometry.fit import observe, split, with_dielectrics
from swiftwrf.models.geometry.images import PlaneSet, images
from swiftwrf.models.geometry.planes import image_jacobian, phase_jacobian, plane_set, refine
from swiftwrf.testing import check_saved

GAIN = 0.4  # at normal incidence: a relative permittivity of 5.4, and no reflection at 67 degrees
WALLS = [replace(plane, gain=GAIN if plane.normal[2] else -GAIN, dielectric=True) for plane in built_in_walls()]
REGION = {"low": (0.4, 0.4, 1.6), "high": (5.5, 4.5, 2.3)}  # flat rays to the ceiling


def channels(walls: list[Plane], n: int = 80) -> Spectra:
    """Return spectra and channels at the carrier in a room of the given walls."""
    data = mirror_room({}, n=n, **REGION)
    channel = GeometryModel.of_planes(data, walls).channel(data.position)[:, None]
    return replace(data, channel=channel, store=Store(data.array.spectrum(channel, data.grid)))


def decided(data: Spectra, start: list[Plane]) -> PlaneSet:
    """Return the planes after the decision on dielectrics, from planes of constant gain."""
    config = GeometryConfig()
    scene, _ = observe(data, config)
    room = refine(scene, plane_set(start, 2))
    return with_dielectrics(room, scene, split(scene, folds(data.position, config.validation, 0)), config)


@pytest.mark.parametrize("plane", [WALLS[0], WALLS[3], WALLS[5]], ids=["x", "y", "ceiling"])
@pytest.mark.parametrize("moving", ["transmitter", "receiver"])
def test_a_dielectric_reflects_a_vertically_polarised_wave_by_fresnels_equations(plane, moving):
    """The field is reflected as a vector: perpendicular and parallel to the plane of incidence."""
    data = mirror_room({}, moving=moving, n=20, **REGION)
    room = GeometryModel.of_planes(data, [plane])
    scene, planes = room.link_at(data.position), room.tensors()
    normal = planes.normal[0, 0]
    after = torch.nn.functional.normalize(scene.receiver - images(scene, planes)[0, 0], dim=1)
    before = after - 2 * (after @ normal)[:, None] * normal

    def vertical(ray):
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) - ray * ray[:, 2:]
        return torch.nn.functional.normalize(up, dim=1)

    cosine = (before @ normal).abs()
    index = (1 + GAIN) / (1 - GAIN)
    inside = (1 - (1 - cosine.square()) / index**2).sqrt()  # cosine of the refracted wave
    across = (cosine - index * inside) / (cosine + index * inside)
    along = (index * cosine - inside) / (index * cosine + inside)
    axis = torch.nn.functional.normalize(torch.linalg.cross(before, normal.expand_as(before)), dim=1)
    field, axis_before, axis_after = vertical(before), torch.linalg.cross(before, axis), torch.linalg.cross(after, axis)
    reflected = (across * (field * axis).sum(1))[:, None] * axis
    reflected = reflected + (along * (field * axis_before).sum(1))[:, None] * axis_after
    expected = (reflected * vertical(after)).sum(1)
    torch.testing.assert_close(room.gains(scene)[:, 1].double(), expected, atol=1e-4, rtol=1e-3)


def test_derivatives_by_the_gains_of_dielectrics_are_differences_of_the_field():
    data, step = mirror_room({}, n=10, **REGION), 1e-2
    room = GeometryModel.of_planes(data, WALLS)
    scene, planes = room.link_at(data.position), room.tensors()
    _, jacobian = phase_jacobian(scene, planes, image_jacobian(planes, scene.transmitter))
    for plane in range(len(WALLS)):
        change = step * torch.nn.functional.one_hot(torch.tensor(plane), len(WALLS))
        before, after = (replace(planes, gain=planes.gain + by).channel(scene) for by in (-change, change))
        difference = (after / before).angle() / (2 * step)
        found = jacobian[:, 0, len(WALLS) + plane].T
        assert float((found - difference).norm() / difference.norm()) < 0.02


def test_dielectrics_bring_back_a_ceiling_whose_constant_gain_has_the_sign_of_walls():
    start = [replace(plane, dielectric=False) for plane in WALLS]
    start[5] = replace(start[5], offset_m=WALLS[5].offset_m + 0.1, gain=-0.1)
    room = decided(channels(WALLS), start)
    assert room.dielectric is not None
    assert bool(room.dielectric.all())
    for number, wall in enumerate(WALLS):
        assert float(room.offset[0, number]) == pytest.approx(wall.offset_m, abs=1e-3)
        assert float(room.gain[0, number]) == pytest.approx(wall.gain, abs=0.02)


def test_planes_of_constant_gain_are_no_dielectrics():
    constant = [replace(plane, dielectric=False) for plane in WALLS]
    assert decided(channels(constant), constant).dielectric is None


@pytest.mark.usefixtures("short_searches")
def test_a_search_finds_a_dielectric_from_channels_alone_and_a_file_keeps_it(monkeypatch):
    for name, value in {"SETTINGS": ((4.0, 1e-3),), "N_STEPS": 10, "MAX_CHOICE": 20}.items():
        monkeypatch.setattr(furniture, name, value)
    data = channels([WALLS[5]])
    config = replace(GLANCE, search_distance_m=0.8, n_search_positions=20)
    room, other = (GeometryModel(config).fit(some) for some in (data, replace(data, channel=None)))
    assert room.planes[0].dielectric
    assert room.planes[0].offset_m == pytest.approx(WALLS[5].offset_m, abs=1e-3)
    assert not other.planes[0].dielectric
    check_saved(room, lambda loaded: loaded.channel(data.position))


def test_paths_have_the_gain_of_their_angle():
    data = mirror_room({}, n=20, **REGION)
    varying, constant = (
        GeometryModel.of_planes(data, [replace(WALLS[5], dielectric=dielectric)]) for dielectric in (True, False)
    )
    gain = varying.gains(varying.link_at(data.position))[:, 1]
    flat = int(gain.abs().argmin())
    level = [room.paths(data.position[flat]).set_index("reflections").level_db[(0,)] for room in (varying, constant)]
    assert level[1] - level[0] == pytest.approx(-20 * float((gain[flat].abs() / GAIN).log10()), abs=1e-3)
    assert level[1] - level[0] > 3
