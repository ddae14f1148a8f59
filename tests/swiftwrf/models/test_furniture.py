"""Channels: at subcarriers of known paths, and furniture that is found in them and improves what follows from a room."""

import json
import math
from copy import copy
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import torch
from rooms import built_in_walls, mirror_room

from augment.turbo.artifacts import save_model
from swiftwrf import AngularGrid, InputError, MatchedField, Spectra, simulated_room
from swiftwrf.array.planar import LIGHT_SPEED, PlanarArray
from swiftwrf.data import PropagationPaths
from swiftwrf.data.store import Store
from swiftwrf.locate.features import PathWaves, SpectrumFeatures, channels_beside
from swiftwrf.locate.spectrum_likelihood import SCALES, PathLikelihood
from swiftwrf.models.geometry import GeometryModel, Plane, furniture
from swiftwrf.models.geometry.channels import Channels, coherence, sources, superposed, waves
from swiftwrf.models.geometry.fit import observe
from swiftwrf.models.geometry.furniture import Furniture, fit_furniture
from swiftwrf.models.geometry.images import PlaneSet, images
from swiftwrf.testing import check_saved
from tasks.aoa.room import furniture_panels

WALLS = built_in_walls(0.9)


def furnished(room: GeometryModel, absorption: float) -> Furniture:
    """A shelf of 1 x 2.5 x 0.5 m between half of the positions and the fixed end, in voxels of 0.25 m."""
    low, shape = torch.full((3,), -0.25, dtype=torch.float64), (26, 22, 14)
    values = torch.zeros(shape)
    low_z = 3 if room.moving == "transmitter" else 8
    values[11:15, 5:15, low_z : low_z + 2] = absorption
    reflectivity = torch.full((len(room.planes), 26 * 22), 0.9)
    return Furniture(low, 0.25, values, reflectivity, torch.zeros(shape), 1e-3)


def measured(
    absorption: float, moving="transmitter", n: int = 100, surfaces: tuple[Plane, ...] = (), noise: float = 0.0
) -> tuple[Spectra, GeometryModel]:
    """Return packets of a furnished room at four subcarriers, each with a delay and a phase, and the walls of the room."""
    data = mirror_room({}, moving=moving, n=n)
    walls = GeometryModel.of_planes(data, WALLS)
    truth = GeometryModel.of_planes(data, WALLS)
    shelf = furnished(truth, absorption)
    truth.furniture = shelf.with_surfaces([*surfaces]) if surfaces else shelf
    generator, away = torch.Generator().manual_seed(0), torch.linspace(-10e6, 10e6, 4, dtype=torch.float64)
    frequency = LIGHT_SPEED / data.array.wavelength + away
    channel = truth.channel(data.position, frequency)
    delay, phase = torch.rand(2, n, 1, 1, generator=generator)
    turn = math.tau * (phase - 100e-9 * delay * away[:, None]).float()
    channel = channel * torch.polar(torch.ones_like(turn), turn)
    error = torch.randn(channel.shape, dtype=channel.dtype, generator=generator)
    channel = channel + noise * channel.abs().square().mean(dim=(1, 2), keepdim=True).sqrt() * error
    store = Store(data.array.spectrum(channel, data.grid))
    return replace(data, store=store, channel=channel, frequency_hz=frequency), walls


def fitted(walls: GeometryModel, train: Spectra) -> GeometryModel:
    """The room of known walls with the furniture that its channels show."""
    walls.furnish(train)
    return walls


@pytest.fixture(scope="module", autouse=True)
def one_setting():
    """One size of voxels, fewer steps and folds, because each fit takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"SETTINGS": ((1.0, 1e-3),), "N_STEPS": 70, "MIN_HELD_OUT": 20}.items():
            patch.setattr(furniture, name, value)
        yield


@pytest.fixture(scope="module", params=["transmitter", "receiver"])
def furnished_room(request):
    """Noisy packets of a furnished room, for training and test, and the room fitted to the former."""
    data, walls = measured(6.0, request.param, n=80, noise=0.1)
    train = data.subset(torch.arange(70))
    return train, data.subset(torch.arange(70, 80)), fitted(walls, train)


@pytest.mark.parametrize("furnished_room", ["transmitter"], indirect=True)
def test_furniture_of_a_known_room_is_fitted_again_and_not_searched(furnished_room):
    train, _, room = furnished_room
    some = train[:50]
    with mock.patch("swiftwrf.models.geometry.model.find_furniture", side_effect=AssertionError("no search")):
        found, bare = GeometryModel().fit(some, like=room), copy(room)
        bare.furniture = None
        assert GeometryModel().fit(some, like=bare).furniture is None
    again = fit_furniture(room.furniture.joined(found.tensors()), found.channels(some), room.furniture)
    assert torch.equal(found.furniture.absorption, again.absorption)
    assert found.furniture.voxel_m == room.furniture.voxel_m
    assert not torch.equal(found.furniture.absorption, room.furniture.absorption)


@pytest.mark.parametrize("moving", ["transmitter", "receiver"])
def test_paths_through_voxels_are_those_of_the_image_sources(moving):
    """Without furniture the gains are those of the planes, and the waves sum up to the channel of the planes."""
    data = simulated_room(n=12, seed=2, grid=AngularGrid.hemisphere(8, 32), moving=moving)
    room = GeometryModel.of_planes(data, WALLS, order=3)
    scene, planes = room.link_at(data.position), room.tensors()
    gain = furnished(room, 0.0).gains(planes, scene)
    assert torch.allclose(gain, room.gains(scene), atol=1e-5)
    channel = superposed(gain, waves(planes, scene, torch.ones(1)))[:, 0]
    assert torch.allclose(channel, planes.channel(scene), atol=1e-4)


@pytest.mark.parametrize("moving", ["transmitter", "receiver"])
def test_paths_of_a_position_are_straight_between_reflections_and_name_what_hides_them(moving):
    data, room = measured(4.0, moving, n=20)
    room.furniture = furnished(room, 4.0)
    found = room.paths(data.position[0])
    scene = room.link_at(data.position[:1])
    image = torch.cat([scene.transmitter[None], images(scene, room.tensors())[0]])[:, 0]
    lengths = dict(zip([(), *room.tensors().sequence], (image - scene.receiver).norm(dim=1).tolist(), strict=True))
    assert len(found) == len(lengths), "all paths of a cuboid exist"
    for row in found.itertuples():
        assert row.length_m == pytest.approx(lengths[row.reflections])
        assert len(row.points) == len(row.reflections) + 2
    gain = room.gains(scene)[0]
    direct = found[found.reflections == ()].iloc[0]
    assert direct.level_db == pytest.approx(20 * math.log10(gain[0]), abs=1e-4)
    assert direct.hidden_db == pytest.approx(-direct.level_db, abs=1e-4)
    assert found.level_db.is_monotonic_decreasing
    assert (found.hidden_db > -1e-4).all()
    assert (found.hidden_db > 3).any()
    with pytest.raises(InputError, match="position must have shape"):
        room.paths(data.position[:2])


def test_a_voxel_attenuates_the_direct_path_by_its_length_in_it():
    data = mirror_room({}, moving="transmitter", n=12)
    room = GeometryModel.of_planes(data, [])
    scene = room.link_at(data.position)
    start, ray = data.position, data.fixed_position - data.position
    at = (torch.arange(20_000, dtype=torch.float64) + 0.5)[:, None, None] / 20_000
    x = start + at * ray
    low, high = torch.tensor([2.5, 1.0, 0.5]), torch.tensor([3.5, 3.5, 1.0])
    inside = ((x >= low) & (x < high)).all(-1).double().mean(0) * ray.norm(dim=1)
    gain = furnished(room, 1.5).gains(room.tensors(), scene)[:, 0]
    assert torch.allclose(-gain.log() / 1.5, inside.float(), atol=0.26)  # a sample
    assert float(inside.max()) > 0.2


def test_furniture_is_found_where_it_stands_and_explains_new_channels(furnished_room):
    train, test, room = furnished_room
    walls = GeometryModel.of_planes(train, WALLS)
    channels = walls.channels(test)
    before = 1 - channels.coherence(walls.tensors(), walls.gains(channels.scene))
    assert room.furniture is not None
    after = 1 - channels.coherence(room.reflectors, room.gains(channels.scene))
    assert float(after.mean()) < 0.5 * float(before.mean())
    centre = (
        (torch.tensor([2.75, 2.3, 0.7 if train.moving == "transmitter" else 2.1]).double() - room.furniture.low)
        / room.furniture.voxel_m
    ).long()
    i, j, k = centre.tolist()
    assert room.furniture.absorption[i, j, k] > 10 * room.furniture.absorption.median()
    assert room.furniture.crossed_m.min() == 0  # what no path crosses is unknown
    check_saved(room, lambda loaded: loaded.channel(test.position))


def test_walls_reflect_alike_where_no_path_determines_their_reflectivity():
    """A strong penalty does not pull walls of gain 0.5 to perfect mirrors."""
    data = mirror_room({}, n=20)
    room = GeometryModel.of_planes(data, built_in_walls(0.5))
    scene, start = room.link_at(data.position), replace(furnished(room, 0.0), penalty=1e-2)
    channel = superposed(room.gains(scene), waves(room.tensors(), scene, torch.ones(1)))
    found = furniture.fit_furniture(room.tensors(), Channels(scene, channel, torch.ones(1)), start)
    assert found.reflectivity.mean() == pytest.approx(0.5, abs=0.1)


def test_a_reflecting_surface_is_found_where_it_is():
    lamp = Plane((0.0, 0.0, 1.0), 2.2, 0.9)
    data, walls = measured(1.0, n=120, surfaces=(lamp,))
    room = fitted(walls, data.subset(torch.arange(100)))
    assert room.furniture is not None
    (found,) = room.furniture.surfaces
    assert (found.normal, found.offset_m) == (lamp.normal, pytest.approx(lamp.offset_m, abs=0.01))
    channels = room.channels(data.subset(torch.arange(100, 120)))
    missing = 1 - channels.coherence(room.reflectors, room.gains(channels.scene))
    assert float(missing.median()) < 0.1
    check_saved(room, lambda loaded: loaded.channel(data.position[:5]))


def test_furniture_is_drawn_by_height_and_hatched_where_it_is_unknown(tmp_path):
    data, walls = measured(0.0, n=20)
    shown = furnished(walls, 2.0)
    shown = replace(shown, crossed_m=(torch.arange(14) > 1).float().expand(26, 22, 14).clone())
    x, y, values = shown.in_plan(0.5, 1.0)
    assert (len(x), len(y), values.shape) == (26, 22, (22, 26))
    assert values[(y > 1.0) & (y < 3.5)][:, (x > 2.5) & (x < 3.5)].min() == pytest.approx(2 * 20 / math.log(10))
    assert values[0, 0] == 0
    assert math.isnan(shown.in_plan(0.0, 0.24)[2][0, 0])
    assert shown.plot(0.0, 0.24).get_xlabel() == "x [m]"
    walls.furniture = shown
    save_model(walls, "0.3", data, tmp_path)
    found = json.loads((tmp_path / "geometry-mix0.3.json").read_text())["furniture"]
    assert (found["shape"], found["voxel_m"], found["surfaces"]) == ([26, 22, 14], 0.25, [])
    assert [11, 5, 3, pytest.approx(2 * 20 / math.log(10), abs=0.01)] in found["voxels"]
    points = dict(np.load(tmp_path / "room-mix0.3.npz"))
    assert points["plan"].shape == (3, 22, 26)
    assert len(furniture_panels(walls.to_json()["planes"], points)) == 3


def test_an_empty_room_has_no_furniture_and_spectra_alone_have_none():
    data, walls = measured(0.0, n=40)
    assert fitted(walls, data).furniture is None
    walls.furnish(replace(data, channel=None))
    assert walls.furniture is None
    with pytest.raises(InputError, match="contains spectra alone"):
        walls.channels(replace(data, channel=None))


def test_phases_of_channels_have_no_alias_and_those_of_packets_are_the_signal():
    data, _ = measured(0.0, n=20)
    scene, rows = observe(data)
    assert scene.channel.shape == (20, 1, 16)
    assert len(rows) == 20
    assert torch.allclose(scene.channel[:, 0], data.channel[:, 1].sgn())  # next to the carrier
    packets = replace(data, channel=data.channel[:, [1] * 3], frequency_hz=None)
    match = (observe(packets)[0].channel * scene.channel.conj()).sum(-1).abs() / 16
    assert torch.allclose(match, torch.ones_like(match), atol=1e-5)


@pytest.mark.parametrize("furnished_room", ["transmitter"], indirect=True)
def test_positions_are_located_by_noisy_packets_through_furniture(furnished_room):
    train, test, room = furnished_room
    cells = {"n_best": 15, "n_background": 8, "n_split": 8, "spacing": 0.3, "max_cells": 4000}
    locator = MatchedField(**cells, n_rounds=2, n_calibration=12).fit(train, room=room)
    posterior = locator.locate(test)
    error = (posterior.median - test.position).norm(dim=1)
    assert float(error.median()) < 0.5 * test.array.wavelength
    check_saved(locator, lambda loaded: loaded.locate(test.channel).log_weight)
    with pytest.raises(InputError, match="was fitted to channels"):
        locator.locate(test.spectrum)


def test_dense_channels_locate_where_the_room_explains_little():
    data, walls = measured(0.0, n=50)
    generator = torch.Generator().manual_seed(0)
    away = torch.rand(50, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.3, 0.3, 0.0])
    position = data.position.mean(dim=0) + away
    unknown = torch.polar(torch.ones(16), 2.0 * torch.randn(16, generator=generator))  # of each element
    channel = walls.channel(position, data.frequency_hz[:1]) * unknown
    store = Store(data.array.spectrum(channel, data.grid))
    data = replace(data, position=position, channel=channel, frequency_hz=None, store=store)
    train, test = data.subset(torch.arange(40)), data.subset(torch.arange(40, 50))
    cells = {"n_best": 15, "n_background": 8, "n_split": 8, "max_cells": 4000, "n_rounds": 2, "n_calibration": 12}
    posterior = MatchedField(**cells).fit(train, room=walls).locate(test)
    error = (posterior.median - test.position).norm(dim=1)
    assert float(error.median()) < 0.1 * test.array.wavelength


@pytest.mark.parametrize("moving", ["transmitter", "receiver"])
def test_channels_beside_positions_follow_from_the_paths_there(moving):
    data, walls = measured(0.0, moving, n=10)
    frequency = data.frequency_hz * data.array.wavelength / LIGHT_SPEED
    line = 0.15 * data.array.wavelength * torch.tensor([-1.0, 1.0], dtype=torch.float64)
    away = torch.cartesian_prod(line, line, line)
    exact = PathWaves.at(walls, (data.position[:, None] + away).flatten(0, 1), frequency).channel
    beside = coherence(channels_beside(walls, data.position, away, frequency), exact)
    assert beside.median() > 0.95
    assert beside.quantile(0.1) > 0.9  # where the paths nearly cancel, small changes of their angles count
    unmoved = PathWaves.at(walls, data.position.repeat_interleave(8, 0), frequency).channel
    assert coherence(unmoved, exact).median() < 0.8  # the field changes over these distances


@pytest.mark.parametrize("moving", ["transmitter", "receiver"])
def test_waves_at_frequencies_are_spherical_waves_of_the_images(moving):
    data, walls = measured(0.0, moving, n=5)
    ratio = data.frequency_hz * data.array.wavelength / LIGHT_SPEED
    scene = walls.link_at(data.position)
    ray = (sources(walls.reflectors, scene) - scene.receiver).movedim(1, 0)  # (n, 1 + S, 3)
    length = ray.norm(dim=-1, keepdim=True)
    phase = (ray / length) @ scene.element.double().T - scene.wavenumber * length
    expected = torch.polar((1 / length)[..., None, :].expand(-1, -1, 4, 16), ratio[:, None] * phase[..., None, :])
    found = waves(walls.reflectors, scene, ratio)
    assert (found - expected).abs().max() < 1e-4 * expected.abs().max()  # phases of 500 rad are rounded in float32
    assert (found[:, :, :1] - expected[:, :, 1:2]).abs().max() > 1e-2 * expected.abs().max()


def test_the_likelihood_of_channels_is_a_normal_distribution_that_no_delay_or_phase_changes():
    data, walls = measured(0.0, n=6)
    frequency = data.frequency_hz * data.array.wavelength / LIGHT_SPEED
    at = PathWaves.at(walls, data.position, frequency)
    log_variance = torch.linspace(-4.0, -1.0, 10)
    likelihood = PathLikelihood(walls, log_variance)

    def value(channel):
        return likelihood(at, SpectrumFeatures.of_channels(channel, data.array))

    known, (_, diffuse, floor) = at.channel, log_variance[-3:].exp().double()
    wave, mean, variance = at.wave.flatten(2).cdouble(), known.flatten(1).cdouble(), likelihood._variance.double()
    x = mean / mean.abs().square().mean(1, keepdim=True).sqrt()
    scene = walls.link_at(walls.region()[:1])
    length = (sources(walls.reflectors, scene) - scene.receiver).norm(dim=-1)[:, 0]
    detour = (length - length[0]).square().mean().sqrt() * scene.wavenumber
    over_frequency = (-(detour * (frequency[:, None] - frequency)).square() / 2).exp()
    scattered = torch.kron(over_frequency, likelihood._isotropic.real.double())
    densities = []
    for scale in SCALES:  # of the variances of gains and scattering
        power = scale * (variance[:, None] * wave.abs().square()).sum(1).mean(1) + mean.abs().square().mean(1)
        noise = (scale * diffuse * scattered + floor * torch.eye(64)) / (1 + scale * diffuse + floor)
        total = power * (1 + scale * diffuse + floor)
        covariance = (
            torch.einsum("nsk,nsl,s->nkl", wave, wave.conj(), scale * variance.cdouble()) / total[:, None, None]
        )
        covariance, m = covariance + noise, mean / total.sqrt()[:, None]

        def product(a, b, covariance=covariance):
            return (a.conj() * torch.linalg.solve(covariance, b)).sum(1)

        match = 2 * product(m, x).abs()
        density = match + torch.special.i0e(match).log() - (product(x, x) + product(m, m)).real
        densities.append(density - torch.linalg.slogdet(covariance).logabsdet)
    expected = torch.stack(densities).logsumexp(dim=0)
    assert torch.allclose(value(known).double(), expected, atol=0.15)  # the estimated phases fit slightly better
    turn = torch.rand(6, 4, 1, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(value(known * torch.polar(torch.ones(6, 4, 1), 7 * turn)), value(known), atol=0.05)
    assert bool((value(data.channel[[1, 2, 3, 4, 5, 0]]) < value(data.channel)).all())


def paths(length: torch.Tensor | None) -> PropagationPaths:
    """Two links with a path each along +x, 3 m long, of the amplitude of free space at 2.4 GHz."""
    wavelength = LIGHT_SPEED / 2.4e9
    gain = torch.polar(
        torch.tensor(wavelength / (4 * math.pi * 3)).double(), torch.tensor(-6 * math.pi / wavelength).double()
    )
    receiver = torch.tensor([[3.0, 0, 0], [0, 3.0, 0]], dtype=torch.float64)
    none = torch.zeros(2, 3, dtype=torch.float64)
    return PropagationPaths(
        none, receiver, torch.ones(2).long(), -receiver / 3, gain.expand(2), torch.ones(2).bool(), 2.4e9, length
    )


@pytest.mark.parametrize("length", [None, torch.full((2,), 3.0, dtype=torch.float64)])
def test_the_phase_of_subcarriers_turns_by_the_delay_of_the_path(length):
    array = PlanarArray.square(2, 2.4e9)
    channel, frequency = paths(length).subcarriers(array, 3, 20e6)
    assert frequency.tolist() == [2.39e9, 2.4e9, 2.41e9]
    assert torch.allclose(channel[:, 1], paths(length).channel(array))
    turned = (channel[:, 2] * channel[:, 0].conj()).angle()
    expected = -math.tau * 20e6 / LIGHT_SPEED * (3 - paths(length).direction[:, :2] @ array.element.double().T)
    assert torch.allclose(turned, expected, atol=1e-6)
    spectra = paths(length).spectra("paths", subcarriers=3, bandwidth_hz=20e6, grid=AngularGrid.hemisphere(8, 32))
    assert spectra.channel.shape == (2, 3, 16)
    assert spectra.frequency_hz.tolist() == frequency.tolist()
    assert paths(length).spectra("paths", grid=AngularGrid.hemisphere(8, 32)).channel is None


def test_subcarriers_of_paths_without_lengths_are_refused():
    other = replace(paths(None), gain=paths(None).gain * 1j)
    with pytest.raises(InputError, match="need the length of each path"):
        other.subcarriers(PlanarArray.square(2, 2.4e9), 2, 20e6)
    other.subcarriers(PlanarArray.square(2, 2.4e9))
    for number, bandwidth in ((8, 0.0), (1, 20e6), (8, 80.0), (8, 3e9)):
        with pytest.raises(InputError, match="goes with several subcarriers"):
            paths(None).subcarriers(PlanarArray.square(2, 2.4e9), number, bandwidth)


def test_coherence_is_one_for_any_phase_of_each_snapshot():
    channel = torch.randn(5, 3, 4, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))
    turned = channel * torch.polar(torch.ones(5, 3, 1), torch.rand(5, 3, 1)) * 7
    assert torch.allclose(coherence(channel, turned), torch.ones(5))
    assert isinstance(GeometryModel.of_planes(simulated_room(n=10), []).tensors(), PlaneSet)


def test_walls_follow_from_a_subcarrier_beside_the_carrier():
    data, walls = measured(0.0, n=40)
    moved = replace(walls.estimate, planes=[replace(p, offset_m=p.offset_m + 0.005) for p in walls.planes])
    walls.estimate = moved
    found = walls.refined_on(observe(data)[0])
    for plane, truth in zip(found.planes, WALLS, strict=True):
        assert plane.offset_m == pytest.approx(truth.offset_m, abs=1e-3)


def test_channels_do_not_depend_on_the_positions_beside():
    data, walls = measured(2.0, n=40)
    room = GeometryModel.of_planes(data, WALLS)
    room.furniture = furnished(walls, 2.0)
    frequency = LIGHT_SPEED / data.array.wavelength
    together = room.channel(data.position, torch.tensor([frequency]))
    alone = torch.cat([room.channel(at[None], torch.tensor([frequency])) for at in data.position])
    torch.testing.assert_close(alone, together, rtol=1e-5, atol=1e-6)
