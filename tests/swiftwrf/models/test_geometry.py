"""Rooms in closed form found again, conclusions on what is not identifiable, samples, state."""

from copy import copy
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from rooms import ARRAY, GRID, built_in_walls, mirror_room
from small import GLANCE
from threadpoolctl import ThreadpoolController

from augment.mix import withhold
from swiftwrf import AngularGrid, InputError, simulated_room
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.store import Store
from swiftwrf.gp import GaussianProcess, Kernel
from swiftwrf.metrics import psnr
from swiftwrf.models.geometry import GeometryConfig, GeometryModel, Plane, path_gains, search, uncertainty
from swiftwrf.models.geometry.fit import _pruned, _with_weak_planes, _without_aliases, observe, split
from swiftwrf.models.geometry.hybrid import HybridModel
from swiftwrf.models.geometry.images import SIDES, PhaseObservations, PlaneSet, field
from swiftwrf.models.geometry.path_gains import (
    PRIORS,
    PathGains,
    choose_prior,
    fit_path_gains,
    kernel_of,
    paths,
    posterior_gradient,
)
from swiftwrf.models.geometry.phase_retrieval import autocorrelation, correlations, retrieve_phases
from swiftwrf.models.geometry.planes import image_jacobian, offset_covariance, phase_jacobian, refine, refine_all
from swiftwrf.models.geometry.search import N_SPHERE_NORMALS, SIGNS, SteeringResponses
from swiftwrf.models.geometry.uncertainty import _AlternativeTable, assess, mode_probabilities, phase_alternatives
from swiftwrf.models.link import Link
from swiftwrf.models.neighbours import NearestModel

QUICK = GeometryConfig(search_distance_m=2.0, beam_width=2)
SIX = {(-1, 0, 0): 0.0, (1, 0, 0): 5.0, (0, -1, 0): 0.0, (0, 1, 0): 4.0, (0, 0, -1): 0.0, (0, 0, 1): 2.8}


def fit(data, **changes):
    return GeometryModel(replace(QUICK, **changes)).fit(data)


def known(data, order=2):
    """Return the room of six planes, without a search."""
    return GeometryModel.of_planes(data, [Plane(n, o, gain=-0.6) for n, o in SIX.items()], order)


def errors(model, planes):
    """Distance of each true plane from the found one with that normal [mm], and that one's deviation [mm]."""
    found = []
    for normal, offset in planes.items():
        unit = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
        near = max(model.planes, key=lambda p: float(torch.tensor(p.normal, dtype=torch.float64) @ unit))
        found.append((1000 * abs(near.offset_m - offset), near.std_mm))
    return found


@pytest.fixture(scope="module")
def noisy():
    return mirror_room(SIX, noise=0.1)


@pytest.fixture(scope="module")
def room(noisy):
    """The room of the noisy spectra, whose planes are known but for a centimetre: a search has its own tests."""
    return GeometryModel().fit(noisy, like=known(noisy).refined_on(observe(noisy)[0]))


def test_elements_may_be_listed_in_any_order():
    """One of two phase aliases fits the room, whatever the order of opposite elements."""
    order = torch.randperm(16, generator=torch.Generator().manual_seed(1))
    plain, shuffled = ARRAY, PlanarArray(ARRAY.element[order], ARRAY.wavelength)
    normal = torch.tensor([list(SIX)], dtype=torch.float64)
    offset = torch.tensor([list(SIX.values())], dtype=torch.float64)
    for array in (plain, shuffled):
        scene, _ = observe(mirror_room(SIX, array=array))
        assert PlaneSet(normal, offset, torch.full((1, 6), -0.6)).score_at(scene) < 1e-3
    assert PlanarArray(ARRAY.element[:7], ARRAY.wavelength).opposite is None


def test_phases_of_the_elements_follow_from_the_spectra():
    generator = torch.Generator().manual_seed(0)
    angle = 3 * torch.randn(30, 16, dtype=torch.float64, generator=generator)
    channel = torch.polar(torch.ones_like(angle), angle)
    data = replace(mirror_room({}, n=30), store=Store(ARRAY.spectrum(channel, GRID)))
    torch.testing.assert_close(correlations(data), autocorrelation(channel, ARRAY), atol=1e-5, rtol=0)
    found, error = retrieve_phases(correlations(data), ARRAY)
    match = torch.stack([(channel.conj() * f).mean(1).abs() for f in (found, found.conj().flip(1))]).amax(0)
    assert float(error.max()) < 1e-3
    assert float(match.min()) > 0.999


@pytest.mark.parametrize("moving", ["receiver", "transmitter"])
def test_derivatives_of_the_phase_are_differences_of_the_field(moving):
    """Includes rooms with oblique planes, and images that a plane makes twice."""
    scene, _ = observe(mirror_room({}, moving=moving, n=10))
    normal = torch.tensor([[[1, 0, 0], [0, 0, -1], [0, 1, 0]], [[1, 0.1, 0], [0.1, 0, -1], [-0.2, 1, 0.1]]]).double()
    normal = torch.nn.functional.normalize(normal, dim=-1)
    offset, gain = torch.tensor([[5.0, 0.4, 4.0], [4.8, 0.2, 4.1]]).double(), torch.full((2, 3), -0.6)
    chain, step = (*PlaneSet(normal[1:], offset[1:], gain[1:]).sequence, (0, 1, 0)), 1e-3
    across = torch.linalg.svd(normal[:, :, None]).Vh[:, :, 1:]
    planes = PlaneSet(normal, offset, gain, only=chain)

    def of_rooms(rooms):
        real, imaginary = rooms.field(scene).chunk(2, dim=1)
        return torch.complex(real, imaginary).permute(2, 0, 1)

    total, jacobian = phase_jacobian(scene, planes, image_jacobian(planes, scene.transmitter, tilt=True))
    torch.testing.assert_close(total.permute(1, 2, 0), of_rooms(planes))
    for plane in range(3):
        for q in range(4):
            moved = []
            for side in (-step, step):
                n, o, g = normal.clone(), offset.clone(), gain.clone()
                if q == 0:
                    o[:, plane] += side
                elif q == 1:
                    g[:, plane] += side
                else:
                    n[:, plane] += side * across[:, plane, q - 2]
                moved.append(of_rooms(PlaneSet(n, o, g, only=chain)))
            difference = (moved[1] / moved[0]).angle() / (2 * step)
            found = jacobian[:, :, 3 * q + plane].permute(1, 2, 0)
            assert float((found - difference).norm() / difference.norm()) < 0.02


@pytest.mark.parametrize("moving", ["receiver", "transmitter"])
def test_fields_and_scores_of_many_rooms_are_those_of_the_definition(moving):
    """Each image, transmitter mirrored in one plane after another, adds gain exp(-j k d) / d at each element."""
    generator = torch.Generator().manual_seed(0)
    scattered = PlanarArray(ARRAY.element + 0.02 * torch.rand(16, 2, generator=generator).double(), ARRAY.wavelength)
    offset, gain = 4 + torch.rand(9, 3, generator=generator).double(), torch.rand(9, 3, generator=generator) - 0.5
    for array in (ARRAY, scattered):
        data = mirror_room({}, moving=moving, n=10)
        observed = torch.randn(10, 16, generator=generator, dtype=torch.complex64)
        link = replace(Link.from_spectra(data), array=array)
        scene = PhaseObservations.of_phases(data.position, link, observed.sgn())
        rooms = PlaneSet(SIDES[[0, 1, 3]].expand(9, 3, 3), offset, gain)
        expected = torch.zeros(9, 10, 16, dtype=torch.complex128)
        for sequence in ((), *rooms.sequence):
            for room in range(9):
                source, strength = scene.transmitter, 1.0
                for plane in sequence:
                    n, o = rooms.normal[room, plane], offset[room, plane]
                    source, strength = source - 2 * ((source @ n) - o)[:, None] * n, strength * gain[room, plane]
                ray = source - scene.receiver
                length = ray.norm(dim=-1, keepdim=True)
                phase = (ray / length) @ scene.element.double().T - scene.wavenumber * length
                expected[room] += torch.polar(torch.ones_like(phase), phase) * strength / length
        found = rooms.field(scene)
        parts = torch.cat([expected.real, expected.imag], dim=-1).permute(1, 2, 0).float()
        torch.testing.assert_close(found, parts, atol=1e-4, rtol=0)
        match = torch.einsum("bnk,nfk->bnf", expected.sgn(), scene.channel.conj().to(torch.complex128))
        coherence = (match.abs().square().amax(-1) / 16**2).float()
        torch.testing.assert_close(scene.coherence(found), coherence.T, atol=1e-4, rtol=0)
        torch.testing.assert_close(scene.score(found), 1 - coherence.mean(1), atol=1e-4, rtol=0)


def test_rooms_are_refined_together_as_one_by_one():
    scene, _ = observe(mirror_room(SIX, n=20))
    normal, offset = torch.tensor([list(SIX)]).double(), torch.tensor([list(SIX.values())]).double()
    room = PlaneSet(normal, offset + 0.01, torch.full((1, 6), -0.5), 2)
    none = PlaneSet(normal[:, :0], offset[:, :0], offset[:, :0], 2)
    rooms = [room, room.without(0), replace(room, offset=offset - 0.01), none]
    for together, given in zip(refine_all(scene, rooms, 3), rooms, strict=True):
        alone = refine(scene, given, 3)
        torch.testing.assert_close(together.offset, alone.offset, atol=1e-6, rtol=0)
        torch.testing.assert_close(together.gain, alone.gain, atol=1e-4, rtol=0)
        assert float(together.score) == pytest.approx(together.score_at(scene), abs=1e-5)


@pytest.mark.parametrize(
    ("planes", "gain", "moving"),
    [
        ({(1, 0, 0): 4.6}, -0.7, "receiver"),
        ({(1, 0, 0): 4.6, (0, 0, -1): 0.0}, 0.8, "transmitter"),
    ],
    ids=["one", "two"],
)
def test_rooms_without_noise_are_found_to_a_millimetre(planes, gain, moving):
    model = fit(mirror_room(planes, gain, moving, n=40))
    assert len(model.planes) == len(planes)
    assert max(e for e, _ in errors(model, planes)) < 1
    true = torch.tensor(gain).expand(len(planes)).tolist()
    assert all(abs(p.gain - g) < 0.02 and p.certain for p, g in zip(model.planes, true, strict=True))
    assert model.order == (1 if len(planes) == 1 else 2)


def test_a_sign_does_not_change_for_a_little():
    """Half a turn away the wrong sign explains a weak wall better by chance, but not clearly."""
    scene, _ = observe(mirror_room({(1, 0, 0): 4.6, (0, 0, -1): 0.0}, (-0.6, -0.2), n=40, noise=0.5))
    normal, offset = torch.tensor([[[1, 0, 0], [0, 0, -1]]]).double(), torch.tensor([[4.6, 0.0]]).double()
    room = refine(scene, PlaneSet(normal, offset, torch.tensor([[-0.6, -0.2]])))
    other = phase_alternatives(scene, room)[0]
    assert other.score_at(scene) < 0.99 * room.score_at(scene)
    assert _without_aliases(room, scene, QUICK) is room


def test_a_plane_among_the_positions_has_no_turns():
    """Wavelengths inside of the furthest one, where refinement may leave an oblique plane."""
    scene, _ = observe(mirror_room({(1, 0, 0): 4.6}, n=12, array=PlanarArray.square(4, 60e9)))
    normal, offset = torch.tensor([[[1.0, 0, 0]]]).double(), torch.tensor([[2.0]]).double()
    assert phase_alternatives(scene, PlaneSet(normal, offset, torch.tensor([[-0.6]]), 1)) == []


@pytest.mark.long
@pytest.mark.parametrize("away", [(8, 8, 6, 6, 0, 2), (3, 3, 4, 4, 0, 3)], ids=["whole turns", "half turns"])
def test_planes_that_are_turns_away_together_return(away):
    """Images of images hold planes at wrong places together, from where no one to three of them find back."""
    gain = (-0.4, -0.3, -0.65, -0.75, 0.25, 0.4)
    scene, _ = observe(mirror_room(SIX, gain, "transmitter", n=40))
    normal, offset = torch.tensor([list(SIX)]).double(), torch.tensor([list(SIX.values())]).double()
    true = PlaneSet(normal, offset, torch.tensor([gain]), 2)
    wrong = refine(scene, _AlternativeTable(scene, true).room(away), 20)
    assert float((wrong.offset - offset).abs().max()) > 0.2
    assert wrong.score_at(scene) < 0.02  # explains nearly all
    assert float((_without_aliases(wrong, scene, QUICK).offset - offset).abs().max()) < 1e-3


def test_a_weak_wall_beside_strong_ones_is_added():
    gain = (-0.6, -0.6, -0.12, -0.6, -0.6, -0.6)
    scene, _ = observe(mirror_room(SIX, gain, n=60, noise=0.1))
    normal, offset = torch.tensor([list(SIX)]).double(), torch.tensor([list(SIX.values())]).double()
    rest = refine(scene, PlaneSet(normal, offset, torch.tensor([gain])).without(2))
    folds = split(scene, torch.arange(60) % 5)
    whole = _with_weak_planes(rest, scene, scene, folds, SIGNS[0], QUICK)
    assert whole.normal.shape[1] == 6
    assert float((whole.offset - offset).abs().max()) < 0.02
    assert abs(float(whole.gain[0, 2]) + 0.12) < 0.05
    assert _with_weak_planes(whole, scene, scene, folds, SIGNS[0], QUICK) is whole


def test_scores_of_combinations_are_those_of_their_rooms():
    scene, _ = observe(mirror_room(SIX, n=12))
    normal = torch.tensor(list(SIX)).double()
    offset = [o + 0.05 * torch.arange(1 + i % 3, dtype=torch.float64) for i, o in enumerate(SIX.values())]
    gain = [torch.linspace(-0.6, 0.4, len(o)) for o in offset]
    direct, waves = scene.direct, SteeringResponses.of(scene, normal, offset, gain)
    score = waves.scores(scene, direct)
    base, moving = waves.moved(direct, (1, 2, 4, 5))
    torch.testing.assert_close(moving.scores(scene, base), score[0, :, :, 0])
    for choice in ((0, 0, 0, 0, 0, 0), (0, 1, 2, 0, 1, 2), (0, 1, 0, 0, 0, 1)):
        own = ([t[c] for t, c in zip(table, choice, strict=True)] for table in (offset, gain))
        room = PlaneSet(normal[None], *(torch.stack(row)[None] for row in own), 2)
        assert float(score[choice]) == pytest.approx(room.score_at(scene), abs=1e-5)
        picked = scene.score(direct + waves.of_choices([torch.tensor([c]) for c in choice]))
        torch.testing.assert_close(score[choice], picked[0], atol=1e-5, rtol=0)
    some = torch.tensor([0, 5, 7])
    few = waves.subset(some).first(2).scores(scene.subset(some), direct[some])
    torch.testing.assert_close(few, waves.subset(some).scores(scene.subset(some), direct[some])[:, :2, :2, :, :2, :2])


@pytest.mark.long
@pytest.mark.usefixtures("short_searches")
def test_a_tilted_plane_is_found_to_a_millimetre(monkeypatch):
    monkeypatch.setattr(search, "N_SPHERE_NORMALS", N_SPHERE_NORMALS)
    model = fit(mirror_room({(0.8, 0.5, 0.1): 5.0}, -0.7, n=25), search_distance_m=0.5, beam_width=1, max_order=1)
    assert len(model.planes) == 1
    assert errors(model, {(0.8, 0.5, 0.1): 5.0})[0][0] < 1
    assert model.planes[0].normal == pytest.approx([0.8433, 0.5270, 0.1054], abs=1e-3)


@pytest.mark.parametrize("moving", ["receiver", "transmitter"])
def test_the_field_is_the_sum_over_any_parts_of_its_images(moving):
    """Also where planes are oblique, so that paths are followed through images that the part does not have."""
    scene, _ = observe(mirror_room({}, moving=moving, n=10))
    normal = torch.nn.functional.normalize(torch.tensor([[1, 0.3, 0], [-0.2, 1, 0.1], [0, 0, -1]]).double(), dim=1)
    offset, gain = torch.tensor([[5.2, 4.1, 0.0]]).double(), torch.tensor([[-0.6, 0.5, -0.4]])
    whole = PlaneSet(normal[None], offset, gain)
    parts = sum(field(scene, replace(whole, only=(s,))) for s in whole.sequence)
    torch.testing.assert_close(parts, field(scene, whole))


def test_nothing_to_find_is_no_plane():
    model = fit(mirror_room({}))
    assert model.planes == []
    assert "no plane" in model.conclusion
    assert len(model.image_sources()[0]) == 1


def test_noise_stays_within_the_deviations():
    """Also where floor and ceiling have gains of the other sign."""
    gain = (-0.6, -0.6, -0.6, -0.6, 0.4, 0.4)
    room = fit(mirror_room(SIX, gain, noise=0.1))
    assert len(room.planes) == 6
    assert all(error < 4 * std and error < 20 for error, std in errors(room, SIX))
    assert sorted(plane.gain for plane in room.planes) == pytest.approx(sorted(gain), abs=0.1)


@pytest.mark.usefixtures("short_searches")
def test_positions_in_a_plane_leave_no_plane_certain():
    data = mirror_room(SIX, noise=0.1, n=16, low=(1.5, 1.2, 1.2), high=(3.5, 3.2, 1.2))
    model = fit(data, max_extra_planes=0, beam_width=1, max_order=2)
    assert not any(p.certain for p in model.planes)
    assert "the positions lie on a plane" in model.conclusion
    assert all(0 < p.probability <= 0.5 and p.std_mm < 500 for p in model.planes)


@pytest.mark.usefixtures("short_searches")
def test_pure_noise_has_no_certain_plane():
    generator = torch.Generator().manual_seed(0)
    data = mirror_room({}, n=10)
    channel = torch.randn(10, 16, dtype=torch.complex128, generator=generator)
    noise = replace(data, store=Store(ARRAY.spectrum(channel, GRID)))
    model = GeometryModel(GLANCE).fit(noise)
    assert not any(p.certain for p in model.planes)


def test_probabilities_of_rooms_follow_from_their_leads():
    generator = torch.Generator().manual_seed(0)
    explained = 3 + 0.5 * torch.randn(4, 60, generator=generator) - torch.tensor([0.0, 0.1, 0.2, 0.5])[:, None]
    log_prior = torch.tensor([-0.5, 0.0, 0.3, 0.0]).double()
    difference = (explained[:1] - explained[1:]).double().numpy()
    lead = difference.mean(axis=1) / (difference.std(axis=1, ddof=1) / np.sqrt(60))
    weight = np.exp(log_prior.numpy() - np.array([0.0, *(lead * np.abs(lead))]))
    np.testing.assert_allclose(mode_probabilities(explained, log_prior), weight / weight.sum(), rtol=1e-4)


@pytest.mark.parametrize(("every", "low", "high"), [(2, 0.45, 0.55), (3, 0.9, 1.0), (61, 0.99, 1.0)])
def test_a_wall_has_the_probability_that_the_spectra_leave_it(monkeypatch, every, low, high):
    """Every second, third or no spectrum is of a wall elsewhere, which is the only alternative."""
    region = {"low": (0.5, 0.5, 0.5), "high": (4.3, 3.5, 2.2)}
    here, there = (mirror_room({(1, 0, 0): offset}, n=60, noise=0.1, **region) for offset in (4.6, 5.4))
    of_other = torch.arange(60) % every == every - 1
    mixed = replace(here, store=Store(torch.where(of_other[:, None, None], there.spectrum, here.spectrum)))
    scene, _ = observe(mixed)
    rooms = [GeometryModel.of_planes(here, [Plane((1, 0, 0), o, -0.6)], 1).tensors() for o in (4.6, 5.4)]
    wall, other = (refine(scene, room, 20) for room in rooms)
    monkeypatch.setattr(uncertainty, "_beside", lambda *_: [other])
    (plane,) = assess(mixed, scene, wall, 0.0, searched=False).planes
    missing = [1 - room.coherence(scene).double().numpy() + 1e-5 for room in (wall, other)]
    difference = np.log(missing[1]) - np.log(missing[0])
    lead = difference.mean() / (difference.std(ddof=1) / np.sqrt(60))
    assert plane.probability == pytest.approx(1 / (1 + np.exp(-lead * abs(lead))), abs=0.01)
    assert low <= plane.probability <= high
    assert plane.certain == (plane.probability >= 0.9)
    assert plane.rival_m == (pytest.approx(float(other.offset)) if plane.probability < 0.99 else None)


def test_a_search_takes_the_most_probable_room_and_a_known_room_stays():
    """Half a phase period away a wall of the other sign explains the spectra nearly as well."""
    data = mirror_room({(1, 0, 0): 4.6}, n=60, noise=0.1, low=(0.5, 0.5, 0.5), high=(4.3, 3.5, 2.2))
    scene, _ = observe(data)
    alias = refine(scene, GeometryModel.of_planes(data, [Plane((1, 0, 0), 4.69, 0.6)], 1).tensors())
    ((moved,), (kept,)) = (assess(data, scene, alias, 0.0, searched).planes for searched in (True, False))
    assert (moved.offset_m, moved.gain) == pytest.approx((4.6, -0.6), abs=0.02)
    assert moved.certain
    assert (kept.offset_m, kept.gain) == pytest.approx((4.69, 0.6), abs=0.05)
    assert kept.probability < 0.1
    assert kept.rival_m == pytest.approx(4.6, abs=0.01)


def test_a_room_on_other_spectra_has_their_uncertainty_and_scores(room):
    """The new spectra are a fifth as many, with three times the noise."""
    other = mirror_room(SIX, n=20, noise=0.3, seed=3)
    found = GeometryModel().fit(other, like=room)
    scene, _ = observe(other)
    power = [
        autocorrelation(channel, ARRAY).numpy().ravel()
        for channel in (found.tensors().channel(scene).sgn(), scene.channel[:, 0])
    ]
    correlation = np.vdot(*power).real / np.sqrt(np.vdot(power[0], power[0]).real * np.vdot(power[1], power[1]).real)
    assert found.estimate.unexplained == pytest.approx(1 - correlation**2, abs=1e-4)
    systematic = (0.02 * ARRAY.wavelength) ** 2 * (1 - correlation**2)
    variance = offset_covariance(scene, found.tensors()).diagonal() + systematic
    assert [p.std_mm for p in found.planes] == pytest.approx((1000 * variance.sqrt()).tolist(), rel=1e-3)
    assert min(p.std_mm for p in found.planes) > 1.5 * max(p.std_mm for p in room.planes)
    assert found.estimate.score_held_out > 2 * room.estimate.score_held_out
    certain = sum(p.probability >= 0.9 for p in found.planes)
    assert found.conclusion == f"6 planes, {certain} of them identifiable"


def test_other_spectra_decide_which_planes_of_a_room_exist():
    """Six planes stand a centimetre off, and two are not there: the other four remain, at their places."""
    real = {normal: offset for normal, offset in SIX.items() if normal[1] == 0}
    data = mirror_room(real, 4 * (-0.6,), n=40, noise=0.1)
    moved = [Plane(normal, offset + 0.01, gain=-0.5) for normal, offset in SIX.items()]
    found = GeometryModel.of_planes(data, moved).decided_on(data[:30])
    assert {plane.normal for plane in found.planes} == set(real)
    assert max(error for error, _ in errors(found, real)) < 3
    nothing = mirror_room({}, n=20, noise=0.3)
    assert found.decided_on(nothing).conclusion == "no plane explains the spectra"


def test_an_update_multiplies_the_odds_of_each_plane(room):
    other = mirror_room(SIX, n=20, noise=0.3, seed=3)
    own = GeometryModel().fit(other, like=room)
    planes = [replace(p, probability=q) for p, q in zip(room.planes, (0.2, 0.5, 0.9, 1.0, 0.6, 0.3), strict=True)]
    doubtful = copy(room)
    doubtful.estimate = replace(room.estimate, planes=planes)
    found = doubtful.update(other)
    for before, new, after in zip(planes, own.planes, found.planes, strict=True):
        odds = np.float64(before.probability) * new.probability
        other_odds = (1 - before.probability) * (1 - new.probability)
        assert after.probability == pytest.approx(odds / (odds + other_odds))
    certain = sum(p.probability >= 0.9 for p in found.planes)
    assert found.conclusion == f"6 planes, {certain} of them identifiable"


@pytest.mark.long
def test_the_default_room_of_the_report_has_a_deviation_of_its_own_for_each_wall():
    """The spectra are those of `swiftwrf aoa --mix 0.3`. A box hides the wall y = 0, whose alternatives are as good."""
    train, _ = simulated_room().split("random")
    measured, _ = withhold(train, 0.3, 0)
    model = GeometryModel(validation="random").fit(measured)
    walls = {(-1, 0, 0): 0.0, (1, 0, 0): 6.0, (0, -1, 0): 0.0, (0, 1, 0): 5.0, (0, 0, -1): 0.0, (0, 0, 1): 3.0}
    for normal, offset in walls.items():
        found = max(model.planes, key=lambda plane: float(np.dot(plane.normal, normal)))
        assert found.std_mm < 15
        # a plane that is elsewhere is called uncertain, and the wall is named as its strongest alternative
        offsets = (found.offset_m,) if found.certain else (found.offset_m, found.rival_m)
        assert min(abs(1000 * (at - offset)) for at in offsets) < 15
    certain = [p.normal for p in model.planes if p.certain]
    assert (0, -1, 0) not in certain
    assert len(certain) >= 4


def test_an_array_that_does_not_produce_the_spectra_is_refused():
    with pytest.raises(InputError, match="check its geometry and carrier"):
        fit(replace(mirror_room(SIX, n=12), array=PlanarArray.square(4, 915e6, spacing=0.11)))


@pytest.mark.usefixtures("short_searches")
def test_the_same_seed_finds_the_same_room(noisy):
    few = noisy.subset(torch.arange(12))
    one, other = (GeometryModel(GLANCE).fit(few).to_json() for _ in range(2))
    assert one == other


def test_json_and_images_describe_the_room(room):
    content = room.to_json()
    assert set(content) == {"planes", "order", "score_held_out", "unexplained"}
    assert set(content["planes"][0]) == {*(field.name for field in fields(Plane)), "certain"}
    position, gain, order = room.image_sources()
    assert len(position) == len(gain) == len(order) == 25
    assert torch.equal(position[0], room.fixed_position)


def test_hybrid_is_not_worse_than_geometry():
    data = simulated_room(n=60, grid=GRID)
    train, test = data.split("random")
    room = GeometryModel.of_planes(train, built_in_walls()).refined_on(observe(train)[0])
    hybrid = HybridModel().fit(train, like=room)
    gained = psnr(hybrid.synthesize(test.position), test.spectrum) - psnr(room.synthesize(test.position), test.spectrum)
    assert float(gained.mean()) > -0.5


def with_path_gains(hybrid, path_gains):
    """A copy of the hybrid with other path gains."""
    other = copy(hybrid)
    other.path_gains = path_gains
    return other


def test_path_gains_are_fitted_with_one_thread(monkeypatch):
    """Several threads wait for each other after each of many small products: 24 s in place of 7 s on two cores."""
    found = set()

    def recorded(*given):
        blas = (library["num_threads"] for library in ThreadpoolController().select(user_api="blas").info())
        found.update({torch.get_num_threads(), *blas})
        return posterior_gradient(*given)

    data = simulated_room(n=20, grid=AngularGrid.hemisphere(8, 32))
    room = GeometryModel.of_planes(data, [Plane((0.0, 0.0, -1.0), offset_m=0.0, gain=-0.6)])
    scene, _ = observe(data)
    monkeypatch.setattr(path_gains, "posterior_gradient", recorded)
    before = torch.get_num_threads()
    torch.set_num_threads(4)
    try:
        fit_path_gains(room, scene, Kernel())
    finally:
        torch.set_num_threads(before)
    assert found == {1}


@pytest.mark.parametrize("prior", PRIORS.values(), ids=list(PRIORS))
def test_the_gradient_of_path_gains_is_that_of_their_definition(prior):
    data = mirror_room(SIX, n=30)
    room = known(data, order=1)
    scene = observe(data)[0]
    kernel = kernel_of(scene.moving)
    wave, gain = paths(room, scene)
    root = torch.linalg.cholesky(kernel.covariance(scene.moving.double())).float()
    generator = torch.Generator().manual_seed(1)
    sample, normal = (torch.randn(30, 8, gain.shape[1], 2, generator=generator) for _ in range(2))
    normal.requires_grad_()

    change = torch.tensor(prior.std) * torch.einsum("mn,nfsc->mfsc", root, normal)
    field = (gain[:, None] + torch.view_as_complex(change)) @ wave
    match = torch.einsum("nfk,nak->nfa", field.sgn(), scene.channel.conj())
    missing = 1 - match.abs().square().amax(-1) / field.shape[-1] ** 2
    loss = missing.sum() / prior.missing_scale + (normal - sample).square().sum() / 2
    (expected,) = torch.autograd.grad(loss, normal)
    found = posterior_gradient(scene, wave, gain, root, sample, prior)(normal.detach())
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


def test_path_gains_follow_a_shadow():
    """A wall that does not reflect to one half of the region: its amplitude is known where the phases determine it."""
    whole, bare = mirror_room(SIX, n=140), mirror_room({n: o for n, o in SIX.items() if n != (0, 0, 1)}, n=140)
    hidden = whole.position[:, 0] > 2.5
    spectrum = torch.where(hidden[:, None, None], bare.spectrum, whole.spectrum)
    data = replace(whole, store=Store(spectrum))
    train, test = data.subset(torch.arange(0, 110)), data.subset(torch.arange(110, 140))
    room = GeometryModel().fit(train, like=known(train))
    hybrid = HybridModel().fit(train, like=room)
    assert hybrid.path_gains is not None
    gained = psnr(hybrid.synthesize(test.position), test.spectrum) - psnr(room.synthesize(test.position), test.spectrum)
    assert float(gained.median()) > 5
    process, paths = hybrid.path_gains.process, hybrid.path_gains.n_paths
    first = process.value[:, : 2 * paths]  # one of the fields that are averaged
    one = PathGains(GaussianProcess(process.kernel, process.known, first), paths)
    worse = with_path_gains(hybrid, one).synthesize(test.position)
    better = hybrid.synthesize(test.position)
    assert float(psnr(worse, test.spectrum).median()) < float(psnr(better, test.spectrum).median())
    again = HybridModel.from_state(*hybrid.state())
    assert torch.equal(again.synthesize(test.position), hybrid.synthesize(test.position))
    like = HybridModel().fit(train.subset(torch.arange(60)), like=hybrid)
    assert like.path_gains is not None
    assert like.path_gains.process.kernel == hybrid.path_gains.process.kernel
    assert [plane.normal for plane in like.room.planes] == [plane.normal for plane in room.planes]


@pytest.mark.long
def test_path_gains_are_held_out_from_spectra_without_observed_phases_too():
    """Predictions of one fold depend on the observed spectra of the other folds alone."""
    data, fold = mirror_room(SIX, n=80), torch.arange(80) % 3
    kernel = Kernel(0.5, matern12_weight=1.0, noise=1e-3)
    few = GeometryConfig(max_spectra=40)
    hybrid, like = HybridModel(few), HybridModel()
    hybrid._room, hybrid.grid = known(data), data.grid
    like._room = hybrid._room
    like.path_gains = PathGains(GaussianProcess(kernel, data.position, torch.zeros(80, 2)), 1)
    held_out = hybrid._fit_path_gains(data, fold, like)
    scene, rows = observe(data, few)
    assert len(rows) <= 40
    for number in range(3):
        fitted = fit_path_gains(hybrid.room, scene.subset((fold[rows] != number).nonzero()[:, 0]), kernel)
        expected = ARRAY.spectrum(fitted.channel(hybrid.room, data.position[fold == number]), GRID)
        torch.testing.assert_close(held_out[fold == number], expected)


@pytest.mark.parametrize(("order", "chosen"), [(1, 3), (2, 2)])
def test_image_sources_of_a_higher_order_are_added_where_held_out_spectra_need_them(order, chosen):
    """The spectra contain images up to the second order."""
    data = mirror_room(SIX, n=100)
    found = known(data, order)
    room, prior, _ = choose_prior(found, observe(data)[0], torch.arange(100) % 5)
    assert (room.order, prior) == (chosen, "tight")
    assert found.order == order


def test_fits_that_the_choice_of_a_prior_hands_on_are_those_of_the_folds():
    data, fold = mirror_room(SIX, n=60), torch.arange(60) % 3
    found = known(data, order=1)
    scene, _ = observe(data)
    room, prior, fits = choose_prior(found, scene, fold)
    assert fits
    for number, handed in fits.items():
        kept = scene.subset((fold != number).nonzero()[:, 0])
        fitted = fit_path_gains(room, kept, kernel_of(scene.moving), prior)
        torch.testing.assert_close(handed.change(data.position), fitted.change(data.position))
    assert not choose_prior(found, observe(mirror_room(SIX, n=210))[0], torch.arange(210) % 2)[2]


def test_weak_planes_are_kept_if_all_folds_together_resolve_them():
    """Noise of the phases hides a floor of gain -0.1 from the positions of the first fold."""
    data = mirror_room({(-1, 0, 0): 0.0, (0, 0, -1): 0.0}, gain=(-0.6, -0.1), n=600, noise=0.3)
    scene, rows = observe(data)
    true = GeometryModel.of_planes(data, [Plane((-1, 0, 0), 0.0, -0.6), Plane((0, 0, -1), 0.0, -0.1)])
    room, splits = refine(scene, true.tensors()), split(scene, rows % 5)
    found = [_pruned(room, scene, some, GeometryConfig()).normal.shape[1] for some in (splits[:1], splits)]
    assert found == [1, 2]


def test_priors_of_path_gains_are_checked(hybrid):
    known, kernel = hybrid.process.known, hybrid.process.kernel
    gains = PathGains(GaussianProcess(kernel, known, torch.zeros(len(known), 2 * 25 * 2)), 25, "tight")
    tensors, header = with_path_gains(hybrid, gains).state()
    assert HybridModel.from_state(tensors, header).path_gains.prior == "tight"
    with pytest.raises(InputError, match=r"path_gains\.prior"):
        HybridModel.from_state(tensors, header | {"path_gains": header["path_gains"] | {"prior": "narrow"}})


def test_path_gains_stay_constant_where_nothing_is_hidden():
    data = mirror_room(SIX, n=120)
    assert HybridModel().fit(data, like=known(data)).path_gains is None


@pytest.fixture(scope="module")
def hybrid(noisy, room):
    return HybridModel().fit(noisy, like=room)


def test_a_room_of_the_same_spectra_is_reused_and_of_others_refined(noisy, room, hybrid):
    assert hybrid.room.estimate is room.estimate
    few = noisy.subset(torch.arange(20))
    for model in (room, hybrid):
        refined = GeometryModel().fit(few, like=model)
        assert [plane.normal for plane in refined.planes] == [plane.normal for plane in room.planes]
        assert refined.to_json() != room.to_json()
    with pytest.raises(InputError, match="cannot reuse the structure"):
        GeometryModel().fit(few, like=NearestModel().fit(few))


def test_spectra_and_their_gradient_are_finite_where_both_ends_meet():
    room = GeometryModel.of_planes(simulated_room(n=10, grid=GRID), built_in_walls())
    at = room.fixed_position[None].clone().requires_grad_()
    spectrum = room.predict(at).mean
    spectrum.sum().backward()
    assert spectrum.isfinite().all()
    assert at.grad.isfinite().all()
