"""Locating: posteriors with known answers, rooms in closed form, invariances, walks, and what is refused."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from quick import command
from rooms import mirror_room
from small import COARSEST

from swiftwrf import AngularGrid, InputError, Rssi, load, rssi_room, simulated_room
from swiftwrf.array.angles import angular_distance, to_direction
from swiftwrf.data.coordinates import Floors
from swiftwrf.data.splits import folds
from swiftwrf.gp import GaussianProcess, Kernel
from swiftwrf.locate import MatchedField, Posterior, Region, RssiLocator, smoothed
from swiftwrf.locate import posterior as module
from swiftwrf.locate.features import PathWaves, SpectrumFeatures
from swiftwrf.locate.posterior import HeldOut, calibrated_pool, normalised, pooled_weights
from swiftwrf.locate.region import Cells, best_cells, refined
from swiftwrf.locate.rssi_likelihood import METRICS, DetectionLikelihood, Fingerprints, ValueLikelihood
from swiftwrf.locate.spectrum_likelihood import BOUNDS, PhaseLikelihood, Student
from swiftwrf.models.geometry import GeometryModel, Plane
from swiftwrf.models.geometry.path_gains import PathGains
from swiftwrf.testing import check_saved

SMALL = {"n_best": 60, "n_background": 40, "n_split": 8, "spacing": 0.4, "n_calibration": 40}
ROOM = [
    Plane((-1.0, 0.0, 0.0), 0.0, -0.6, 0.1),
    Plane((0.0, 1.0, 0.0), 5.0, -0.6, 0.1),
    Plane((0.0, 0.0, -1.0), 0.0, -0.6, 0.1),
]


@pytest.fixture(scope="module")
def floor():
    """RSSI of a small floor, and its locator."""
    train, test = rssi_room(n=150, seed=1).columns(range(0, 12, 2)).split()
    return train, test, RssiLocator(n_cells=600).fit(train)


@pytest.fixture(scope="module")
def closed_form():
    """Spectra without noise that follow exactly from three known planes, and the locator of that room."""
    spectra = simulated_room(n=50, seed=3, grid=AngularGrid.hemisphere(15, 60))
    room = GeometryModel.of_planes(spectra, ROOM)
    exact = replace(spectra, store=type(spectra.store)(room.synthesize(spectra.position)))
    train, test = exact.split()
    return train, test, MatchedField(**SMALL, n_rounds=9).fit(train, room=GeometryModel.of_planes(train, ROOM))


def test_errors_at_held_out_rows_are_those_of_the_posterior_and_of_the_mean_position():
    """RSSI that does not depend on the position locates nothing, RSSI of a floor does."""
    generator = np.random.default_rng(0)
    position = np.column_stack([generator.uniform(0, 20, (60, 2)), np.ones(60)])
    noise = Rssi(generator.normal(-60, 4, (60, 3)).round(), position)
    fold = folds(noise.transmitter_position, "random", 0).numpy()
    mean = np.stack([position[fold != own].mean(axis=0) for own in fold])
    expected = np.linalg.norm(mean - position, axis=1).mean()
    found = RssiLocator(n_cells=300).fit(noise).held_out_m
    assert found["mean"] == pytest.approx(expected, abs=1e-3)
    assert found["posterior"] > 0.8 * expected
    found = RssiLocator(n_cells=300).fit(rssi_room(n=80)).held_out_m
    assert found["posterior"] < 0.7 * found["mean"]


def gaussian_on_a_line(centre, std, n=400):
    """A posterior on a line of cells whose mass is that of a normal distribution."""
    x = torch.linspace(-5, 5, n, dtype=torch.float64)
    at = torch.stack([x, torch.zeros(n), torch.zeros(n)], dim=1)[None]
    return Posterior(at, normalised(-((x - centre) ** 2)[None] / (2 * std**2)), 10 / n)


def test_the_mass_of_a_one_dimensional_posterior_is_right():
    posterior = gaussian_on_a_line(0.7, 0.5)
    assert posterior.mean[0, 0] == pytest.approx(0.7, abs=1e-3)
    assert posterior.median[0, 0] == pytest.approx(0.7, abs=1e-2)
    assert posterior.std[0, 0] == pytest.approx(0.5, abs=1e-3)
    assert posterior.credible_radius(0.8)[0] == pytest.approx(1.2816 * 0.5, abs=0.03)
    assert not posterior.ambiguous[0]


@pytest.mark.parametrize("shared", [True, False])
def test_radii_of_several_levels_contain_the_mass_around_the_median(generator, shared):
    at = 9 * torch.rand(1 if shared else 3, 200, 3, generator=generator, dtype=torch.float64)
    mass = normalised(2 * torch.randn(3, 200, generator=generator, dtype=torch.float64))
    found = Posterior(at, mass, 0.2, inflation=1.5)
    levels = (0.1, 0.5, 0.95)
    radii = found.credible_radii(levels).numpy()
    for row, (point, weight) in enumerate(zip(at.expand(3, -1, -1).numpy(), mass.exp().numpy(), strict=True)):
        median = found.median[row].numpy()
        away = np.linalg.norm(point - median, axis=1)
        assert abs((weight[:, None] * (point - median) / away[:, None]).sum(axis=0)).max() < 0.02  # that of Weiszfeld
        expected = [min(r for r in away if weight[away <= r].sum() >= level) for level in levels]
        np.testing.assert_allclose(radii[row], 1.5 * (np.array(expected) + 0.05))
    for number, level in enumerate(levels):
        assert found.credible_radius(level).tolist() == radii[:, number].tolist()


def test_two_modes_are_ambiguous():
    one, two = gaussian_on_a_line(-3, 0.2), gaussian_on_a_line(3, 0.2)
    weight = torch.logaddexp(one.log_weight + math.log(0.6), two.log_weight + math.log(0.4))
    both = Posterior(one.position, weight, 0.025)
    assert both.ambiguous[0]
    assert not replace(both, mode_width_m=6.5).ambiguous[0]
    assert both.most_likely[0, 0] == pytest.approx(-3, abs=0.05)


def test_the_direction_has_the_smallest_expected_angular_error():
    generator = torch.Generator().manual_seed(0)
    vectors = torch.nn.functional.normalize(torch.rand(1, 40, 3, generator=generator, dtype=torch.float64), dim=2)
    posterior = Posterior(vectors, normalised(torch.randn(1, 40, generator=generator, dtype=torch.float64)))

    def expected(direction):
        return float((posterior.weight[0] * angular_distance(vectors[0], direction.expand(40, -1))).sum())

    best = posterior.direction(vectors)[0]
    for step in 0.03 * torch.randn(50, 3, generator=generator, dtype=torch.float64):
        assert expected(best) <= expected(torch.nn.functional.normalize(best + step, dim=0)) + 1e-4


def test_splitting_cells_keeps_their_mass_and_finds_a_narrow_peak():
    peak = torch.tensor([0.3137, -0.271, 0.05], dtype=torch.float64)
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3)
    cells = Region(corners).cells(1000)

    def evaluate(position):
        return -((position - peak).square().sum(dim=2) / (2 * 0.002**2))[None]

    found = best_cells(cells, -evaluate(cells.position[None])[0], 40, 0, torch.Generator().manual_seed(0))
    volume, values = found.log_volume.exp().sum(), evaluate(found.position)
    for _ in range(10):
        found, values = refined(found, normalised(values[0].double() + found.log_volume), values, evaluate, 8)
    posterior = Posterior(found.position, normalised(values[0].double() + found.log_volume))
    assert (posterior.mean - peak).norm() < 1e-3
    assert found.log_volume.exp().sum() <= volume + 1e-12


def test_cut_cells_fill_the_cells_that_were_cut():
    cells = Region(torch.rand(20, 3, generator=torch.Generator().manual_seed(0))).cells(30)
    parts = cells.cut(3)
    assert torch.allclose(parts.position.unflatten(0, (-1, 27)).mean(dim=1), cells.position)
    assert torch.allclose(parts.log_volume.unflatten(0, (-1, 27)).logsumexp(dim=1), cells.log_volume)
    assert torch.allclose(3 * parts.edge, cells.edge)
    gap = torch.cdist(parts.position, parts.position).fill_diagonal_(torch.inf).amin(dim=1)
    assert torch.allclose(gap, parts.edge.norm(dim=1).min().expand_as(gap))


def test_background_cells_stand_for_all_others():
    position = torch.arange(100, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0, 0])
    volume = torch.full((100,), -math.log(100), dtype=torch.float64)
    cells = Cells(position, volume, torch.eye(3, dtype=torch.float64)[:1], torch.zeros(100, dtype=torch.float64))
    kept = best_cells(cells, torch.zeros(7, 100), 10, 20, torch.Generator().manual_seed(0))
    assert torch.allclose(kept.log_volume.exp().sum(dim=1), torch.ones(7, dtype=torch.float64))


def test_pooling_tempers_what_is_too_certain_and_drops_what_is_noise():
    generator = torch.Generator().manual_seed(0)
    x = torch.linspace(-4, 4, 200, dtype=torch.float64)
    truth = 0.5 * torch.randn(400, 1, generator=generator, dtype=torch.float64)
    seen = truth + torch.randn(truth.shape, generator=generator, dtype=torch.float64)  # standard deviation 1 ...
    claimed = 0.5  # ... of which the likelihood claims a half

    def models(at, noise):
        return torch.stack([-((at - seen) ** 2) / (2 * claimed**2), noise])

    at_candidates = models(x.expand(400, -1), torch.randn(400, 200, generator=generator, dtype=torch.float64))
    at_truth = models(truth, torch.randn(400, 1, generator=generator, dtype=torch.float64))[..., 0]
    prior = (-(x**2) / (2 * 0.5**2)).expand(400, -1)
    weight = pooled_weights(at_truth, at_candidates, prior)
    assert weight[0] == pytest.approx(claimed**2, rel=0.25)
    assert weight[1] < 0.1


def test_regions_hold_where_weights_fit_the_positions_that_choose_them():
    """One likelihood is right and 60 are noise, too many for 20 positions."""
    generator = torch.Generator().manual_seed(0)
    line = torch.linspace(-4, 4, 41, dtype=torch.float64)
    cells = torch.stack([line, 0 * line, 0 * line], dim=1)[None]

    def observations(n: int) -> HeldOut:
        cell = torch.randint(10, 31, (n,), generator=generator)
        seen = line[cell] + torch.randn(n, generator=generator, dtype=torch.float64)
        noise = torch.randn(60, n, len(line), generator=generator, dtype=torch.float64)
        values = torch.cat([-(line - seen[:, None]).square()[None] / 2, noise])
        return HeldOut(
            cells[0, cell], values[:, torch.arange(n), cell], cells, values, torch.zeros(n, len(line)).double()
        )

    inside = []
    for _ in range(5):
        parts, new = [observations(4) for _ in range(5)], observations(100)
        truth, volume = (torch.cat([getattr(part, name) for part in parts]) for name in ("truth", "log_volume"))
        at_truth, values = (
            torch.cat([getattr(part, name) for part in parts], dim=1) for name in ("at_truth", "at_candidates")
        )
        weight, factor, errors = calibrated_pool(parts, 0.1)
        assert errors.shape == (20,)
        of_the_same, too_small, _ = calibrated_pool([HeldOut(truth, at_truth, cells, values, volume)], 0.1)
        assert of_the_same.equal(weight)
        found = Posterior(cells, normalised(torch.einsum("k,knm->nm", weight, new.at_candidates)), 0.1)
        error = (found.median - new.truth).norm(dim=1) / found.credible_radius()
        inside.append([float((error <= limit).double().mean()) for limit in (factor, too_small)])
    assert np.mean(inside, axis=0)[0] > 0.8
    assert np.mean(inside, axis=0)[1] < 0.75


def test_true_positions_that_a_search_misses_do_not_sharpen_the_posterior():
    generator = torch.Generator().manual_seed(0)
    x = torch.linspace(-4, 4, 200, dtype=torch.float64)
    truth = torch.randn(400, 1, generator=generator, dtype=torch.float64)
    std = 0.5
    seen = truth + std * torch.randn(truth.shape, generator=generator, dtype=torch.float64)
    at_candidates, at_truth = ((-((at - seen) ** 2) / (2 * std**2))[None] for at in (x.expand(400, -1), truth))
    at_candidates[:, :100] -= 40  # a quarter of the observations has no candidate near the true position
    prior = torch.full((400, 200), -math.log(200), dtype=torch.float64)
    assert pooled_weights(at_truth[..., 0], at_candidates, prior)[0] == pytest.approx(1, rel=0.25)


def test_residuals_with_outliers_have_heavy_tails():
    generator = torch.Generator().manual_seed(0)
    clean = torch.randn(400, 6, generator=generator)
    heavy = clean / (torch.rand(400, 1, generator=generator) + 0.05)
    degrees = [Student.fit(residual, 1e-6).degrees for residual in (heavy, clean)]
    assert degrees[0] < degrees[1]


def test_a_region_follows_a_path_and_fills_a_room():
    turn = torch.linspace(0, 2 * math.pi, 200, dtype=torch.float64)
    path = torch.stack([4 * turn.cos(), 4 * turn.sin(), torch.zeros_like(turn)], dim=1)
    cells = Region(path).cells(4000)
    inside = cells.log_volume.exp()[cells.position.norm(dim=1) < 2].sum()
    assert inside < 0.05
    assert (cells.position[:, 2].abs() < 1e-9).all()
    room = torch.rand(300, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert Region(room).is_near(Region(room).cells(500).position).double().mean() > 0.9


def test_a_room_in_closed_form_is_located_to_two_millimetres(closed_form):
    """Fits to 32 positions, which calibrate the weights, are not more exact."""
    _, test, locator = closed_form
    posterior = locator.locate(test.spectrum)
    assert (posterior.median - test.position).norm(dim=1).median() < 2e-3
    angles = locator.direction(posterior)
    error = angular_distance(to_direction(*angles.unbind(-1)), to_direction(*test.label.unbind(-1)))
    assert error.rad2deg().median() < 0.05


def test_few_cells_are_enough_where_path_gains_change_with_position():
    spectra = simulated_room(n=200, seed=3, grid=AngularGrid.hemisphere(15, 60))
    room, kernel = GeometryModel.of_planes(spectra, ROOM, order=1), Kernel(20.0, matern12_weight=1.0, noise=1e-3)
    normal = torch.randn(len(spectra), 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    value = 2 * torch.linalg.cholesky(kernel.covariance(spectra.position)) @ normal
    gains = PathGains(GaussianProcess(kernel, spectra.position, value.float()), 4)
    spectrum = room.array.spectrum(gains.channel(room, spectra.position), spectra.grid)
    train, test = replace(spectra, store=type(spectra.store)(spectrum)).split()
    few = {"n_best": 8, "n_background": 10, "n_split": 8, "spacing": 0.15, "n_calibration": 40}
    locator = MatchedField(**few).fit(train, room=room)
    error = (locator.locate(test.spectrum).median - test.position).norm(dim=1)
    assert error.quantile(0.8) < 0.1
    assert locator.inflation < 3


def test_the_order_of_receivers_changes_nothing(floor):
    train, test, locator = floor
    order = list(reversed(range(len(train.receiver_names))))
    again = RssiLocator(n_cells=600).fit(train.columns(order)).locate(test.columns(order).rssi_dbm)
    assert (again.median - locator.locate(test.rssi_dbm).median).norm(dim=1).max() < 0.05


def test_rssi_is_located_better_than_by_fingerprints(floor):
    _, test, locator = floor
    found = (locator.locate(test.rssi_dbm).median - test.transmitter_position).norm(dim=1)
    nearest = (locator.likelihoods.fingerprints.fingerprints.votes(test.rssi_dbm)[2] - test.transmitter_position).norm(
        dim=1
    )
    assert found.median() < nearest.median()


def test_the_prior_region_can_be_given(floor):
    train, test, _ = floor
    corner = Region(train.transmitter_position[train.transmitter_position[:, 0] < 5], margin=0.0, outside=0.01)
    locator = RssiLocator(n_cells=600).fit(train, region=corner)
    assert locator.locate(test.rssi_dbm).median[:, 0].max() < 5.5
    check_saved(locator, lambda loaded: loaded.cells.position)


def test_a_region_takes_finite_positions_of_any_kind():
    known = np.random.default_rng(0).random((50, 3))
    expected = Region(torch.from_numpy(known)).cells(100).position
    for given in (known, known.tolist(), torch.from_numpy(known).float()):
        torch.testing.assert_close(Region(given).cells(100).position, expected, atol=1e-5, rtol=0)
    for given, message in ((known * math.nan, "must be finite"), (known[:1], "at least 2"), (known[:, :2], "shape")):
        with pytest.raises(InputError, match=message):
            Region(given)


def test_rows_at_one_position_are_located_there():
    room = rssi_room(n=60)
    locator = RssiLocator(n_cells=50).fit(replace(room, transmitter_position=torch.ones(60, 3)))
    check_saved(locator, lambda loaded: loaded.locate(room.rssi_dbm).median)
    assert torch.equal(locator.locate(room.rssi_dbm).median, torch.ones(60, 3).double())


def test_neighbours_that_cannot_be_held_out_are_refused():
    room = rssi_room(n=120)
    room.rssi_dbm[room.transmitter_position[:, 0] > 4] = torch.nan
    with pytest.raises(InputError, match="no rows of simulated-floor can be held out to choose the neighbours"):
        Fingerprints.fit(room, torch.arange(120) * 0)


def test_sessions_of_unequal_length_can_be_held_out():
    rows = replace(rssi_room(n=130), session=torch.tensor([0] * 120 + [1] * 5 + [2] * 5))
    locator = RssiLocator(validation="session", n_cells=200).fit(rows)
    assert locator.locate(rows.rssi_dbm[:3]).median.isfinite().all()


@pytest.mark.usefixtures("short_fits")
def test_spectra_at_one_position_are_held_out_together():
    train = simulated_room(n=24, seed=3, grid=AngularGrid.hemisphere(15, 60))
    twice = train.subset(torch.arange(len(train)).repeat_interleave(2))
    room = GeometryModel.of_planes(train, ROOM)
    once, repeated = (MatchedField(**COARSEST).fit(some, room=room).likelihoods[0] for some in (train, twice))
    # errors of path gains that follow the position, which a spectrum at the same position would lower
    assert repeated.coarray[1].scale.trace() == pytest.approx(float(once.coarray[1].scale.trace()), rel=0.1)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("weight", -1.0, "weight must be at least 0"),
        ("weight", 1e30, "weight must be at most 1000"),
        ("likelihoods.0.gains.process.value", 3.4e38, "no candidate position has a finite likelihood"),
        ("likelihoods.0.coarray.0.scale", -1.0, "of no distribution"),
    ],
)
def test_a_locator_whose_numbers_overflow_is_refused(closed_form, name, value, says):
    _, test, locator = closed_form
    tensors, header = locator.state()
    every = tensors | {"weight": torch.ones_like(tensors["weight"])}  # one of weight 0 is not evaluated
    damaged = every | {name: torch.full_like(tensors[name], value)}
    with pytest.raises(InputError, match=says):
        MatchedField.from_state(damaged, header).locate(test.spectrum[:2])


def test_a_file_with_another_number_of_weights_is_refused():
    tensors, header = RssiLocator(n_cells=50).fit(rssi_room(n=40)).state()
    with pytest.raises(InputError, match="weight has shape"):
        RssiLocator.from_state(tensors | {"weight": torch.ones(4, dtype=torch.float64)}, header)


def test_values_have_the_density_of_a_common_offset_and_missing_ones_count_as_missing():
    observed = torch.tensor([[-61.0, math.nan, -84.0], [-50.0, -71.0, -80.0]], dtype=torch.float64)
    maps = torch.tensor([[-60.0, -70.0, -80.0], [-55.0, -66.0, -75.0]]), torch.tensor([[2.0, 3, 4], [1, 2, 5]])
    found = ValueLikelihood(common_db=3.0, scale=1.5, degrees=math.inf).log_likelihood(maps, observed)
    for n, m in ((0, 0), (0, 1), (1, 0), (1, 1)):
        kept = ~observed[n].isnan()
        scale = 9.0 + torch.diag((1.5 * maps[1][m, kept].double()).square())
        error = (observed[n] - maps[0][m])[kept]
        expected = torch.distributions.MultivariateNormal(torch.zeros(len(error)).double(), scale).log_prob(error)
        assert found[n, m] == pytest.approx(float(expected), abs=1e-4)


@pytest.fixture(scope="module")
def building():
    """RSSI on two floors of 30 x 12 m, 3 m apart, each with six access points; a floor takes 15 dB. Six scans a place."""
    generator = torch.Generator().manual_seed(4)
    place = torch.rand(90, 3, generator=generator, dtype=torch.float64) * torch.tensor([30.0, 12.0, 0.0])
    place[45:, 2] = 3.0
    source = torch.cartesian_prod(*(torch.tensor(x) for x in ([5.0, 15.0, 25.0], [3.0, 9.0], [2.5, 5.5]))).double()
    at = place.repeat_interleave(6, dim=0)
    apart = (at[:, None] - source).norm(dim=2).clamp_min(1.0)
    through = 15 * ((at[:, None, 2] > 2) != (source[:, 2] > 4))
    noise = 3 * torch.randn(len(at), 12, generator=generator, dtype=torch.float64)
    rssi = -35 - 28 * apart.log10() - through + noise
    rssi = rssi.masked_fill(rssi < -85, torch.nan)
    return Rssi(rssi, at, floors=Floors(("ground", "first"), (0.0, 3.0)))


def test_floors_are_located_with_their_probability(building, short_fits):
    train, test = building.split()
    locator = RssiLocator(n_cells=400).fit(train)
    posterior = locator.locate(test.rssi_dbm)
    right = building.floors.number(posterior.median) == building.floors.number(test.transmitter_position)
    probability = posterior.floor_probability
    assert right.double().mean() >= 0.95
    assert torch.allclose(probability.sum(dim=1), torch.ones(len(test), dtype=torch.float64))
    assert probability.amax(dim=1).mean() == pytest.approx(float(right.double().mean()), abs=0.05)
    heights = (locator.cells.position, posterior.median.round(decimals=6))
    assert [set(position[:, 2].tolist()) for position in heights] == [{0.0, 3.0}] * 2
    check_saved(locator, lambda loaded: loaded.locate(test.rssi_dbm).log_weight)


def test_each_floor_may_be_a_session_of_its_own(building, short_fits):
    """Then no held-out row has a neighbour on its floor."""
    rows = replace(building, session=building.floors.number(building.transmitter_position))
    locator = RssiLocator(validation="session", n_cells=100).fit(rows)
    assert locator.locate(rows.rssi_dbm[:3]).median.isfinite().all()


def test_neighbours_are_places_that_vote_for_a_floor(building):
    train, test = building.split()
    known = Fingerprints.of(train, k=4)
    distance, place = known.nearest(test.rssi_dbm, 4)
    assert all(len(set(row)) == 4 for row in place.tolist())
    assert (distance.diff(dim=1) >= 0).all()
    assert [tensor.shape for tensor in known.nearest(test.rssi_dbm[:0], 4)] == [(0, 4), (0, 4)]
    part, mean, estimate = known.votes(test.rssi_dbm)
    assert torch.allclose(part.sum(dim=1), torch.ones(len(test), dtype=torch.float64))
    assert torch.equal(estimate, mean[torch.arange(len(test)), part.argmax(dim=1)])
    assert set(estimate[:, 2].round(decimals=6).tolist()) <= {0.0, 3.0}


@pytest.mark.parametrize("metric", METRICS)
def test_distances_of_fingerprints_are_the_definitions(building, metric):
    known = Fingerprints.of(building, metric)
    a, b = (known._excess(building.rssi_dbm[rows]) for rows in (slice(0, 3), slice(None)))
    away = (a[:, None] - b).abs()
    expected = {
        "sorensen": away.sum(dim=2) / (a[:, None] + b).sum(dim=2),
        "manhattan": away.sum(dim=2),
        "euclidean": away.square().sum(dim=2).sqrt(),
    }[metric]
    expected = expected.reshape(3, -1, 6).amin(dim=2).sort(dim=1).values[:, :10]
    assert torch.allclose(known.nearest(building.rssi_dbm[:3], 10)[0], expected, rtol=1e-3, atol=1e-3)


def test_detections_are_learnt():
    generator = torch.Generator().manual_seed(0)
    mean = -100 + 60 * torch.rand(500, 4, generator=generator)
    detected = torch.rand(500, 4, generator=generator) < 0.9 * torch.sigmoid((mean + 85) / 3)
    found = DetectionLikelihood.fit(mean, detected, torch.zeros(4))
    assert found.threshold.tolist() == pytest.approx([-85] * 4, abs=2)
    assert found.loss == pytest.approx(0.1, abs=0.05)


def test_detections_of_receivers_of_other_sensitivity(tmp_path):
    """Half of the receivers detect nothing below -60 dBm; a saved locator knows them, too."""
    room = rssi_room(n=120)
    limit = torch.tensor([-90.0, -60.0]).repeat(6)
    data = replace(room, rssi_dbm=room.rssi_dbm.where(room.rssi_dbm >= limit, torch.nan))
    RssiLocator(n_cells=100, n_calibration=50).fit(data).save(tmp_path / "locator.safetensors")
    threshold = load(tmp_path / "locator.safetensors").likelihoods.detections.threshold
    assert float(threshold[1::2].mean() - threshold[::2].mean()) > 15


def test_variances_of_phases_that_no_room_explains_stay_finite():
    """Signs of the gains that are wrong, images up to the third order, and phases that are nearly noise."""
    sides = [(-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)]
    six = dict(zip(sides, (0.0, 5.0, 0.0, 4.0, 0.0, 3.0), strict=True))
    data = mirror_room(six, n=60, noise=1.0)
    room = GeometryModel.of_planes(data, [Plane(*plane, gain=0.6) for plane in six.items()], order=3)
    assert data.array is not None
    features = SpectrumFeatures.of(data.store.batches(), data.array, data.grid, 0)
    likelihood = PhaseLikelihood.fit([(room, PathWaves.at(room, data.position), features)])
    assert bool((likelihood.log_variance >= BOUNDS[0] - 1e-4).all())
    assert bool((likelihood.log_variance <= BOUNDS[1] + 1e-4).all())
    assert bool(likelihood(PathWaves.at(room, data.position), features).isfinite().all())


# walks


STEP_M, NOISE_M = 0.4, 1.5


def line(cells=301, length=30.0):
    at = torch.zeros(1, cells, 3, dtype=torch.float64)
    at[0, :, 0] = torch.linspace(0, length, cells, dtype=torch.float64)
    return at


def walk(n=60, seed=1):
    """Positions (n,) of a random walk in the middle of the line, and noisy observations of them."""
    generator = torch.Generator().manual_seed(seed)
    steps = STEP_M * torch.randn(n, generator=generator, dtype=torch.float64)
    truth = 15 + steps.cumsum(dim=0)
    return truth, truth + NOISE_M * torch.randn(n, generator=generator, dtype=torch.float64)


def gaussian(at, observed):
    away = at[..., 0] - observed[:, None]
    return Posterior(at, normalised(-0.5 * (away / NOISE_M) ** 2), 0.1)


def kalman(observed, variances):
    """Means of the Rauch-Tung-Striebel smoother of a random walk, with a flat prior."""
    mean, variance = [float(observed[0])], [NOISE_M**2]
    for y, q in zip(observed[1:].tolist(), variances, strict=True):
        p = variance[-1] + q
        gain = p / (p + NOISE_M**2)
        mean.append(mean[-1] + gain * (y - mean[-1]))
        variance.append((1 - gain) * p)
    found = mean[:]
    for i in range(len(mean) - 2, -1, -1):
        found[i] = mean[i] + variance[i] / (variance[i] + variances[i]) * (found[i + 1] - mean[i])
    return torch.tensor(found, dtype=torch.float64)


@pytest.mark.parametrize("is_timed", [True, False])
@pytest.mark.parametrize("is_shared", [True, False])
def test_a_random_walk_has_the_means_of_the_kalman_smoother(is_shared, is_timed):
    """The time between observations widens the step."""
    truth, observed = walk(n=30 if is_timed else 60)
    time = torch.arange(30.0, dtype=torch.float64).square() / 10 if is_timed else None
    at = line() if is_shared else line().expand(len(observed), -1, -1).contiguous()
    alone = gaussian(at, observed)
    found = smoothed(alone, time, STEP_M)
    step = STEP_M * (time.diff() if is_timed else torch.ones(len(observed) - 1))
    expected = kalman(observed, (step**2 + 0.1**2 / 6).tolist())
    inside = expected[:, None].sub(torch.tensor([0.0, 30.0])).abs().amin(dim=1) > 5  # away from the ends of the line
    assert (found.mean[:, 0] - expected)[inside].abs().max() < (0.1 if is_timed else 0.05)
    error, before = ((p.mean[:, 0] - truth).square().mean().sqrt() for p in (found, alone))
    assert is_timed or error < 0.6 * before
    assert found.weight.sum(dim=1).allclose(torch.ones(len(observed), dtype=torch.float64))


def test_products_in_chunks_are_the_same(monkeypatch):
    posterior = gaussian(line(), walk(n=5)[1])
    whole = smoothed(posterior, None, 1.0)
    monkeypatch.setattr(module, "MAX_KEPT_PAIRS", 0)
    monkeypatch.setattr(module, "CHUNK", 1000)
    assert smoothed(posterior, None, 1.0).weight.allclose(whole.weight, atol=1e-6)


def test_neighbours_resolve_two_modes():
    at, observed = line(), torch.tensor([5.0, 5.5, 6.0], dtype=torch.float64)
    modes = gaussian(at, observed).weight
    modes[1] = 0.4 * modes[1] + 0.6 * gaussian(at, observed + 18).weight[1]
    alone = Posterior(at, modes.log(), 0.1)
    assert alone.ambiguous.tolist() == [False, True, False]
    assert alone.most_likely[1, 0] > 20
    found = smoothed(alone, None, 1.0)
    assert not found.ambiguous.any()
    assert abs(float(found.median[1, 0]) - 5.5) < 1


def test_a_single_observation_keeps_its_posterior():
    alone = gaussian(line(), torch.tensor([4.0], dtype=torch.float64))
    assert smoothed(alone, None, 1.0).log_weight.allclose(alone.log_weight, atol=1e-12)


def test_a_jump_and_impossible_candidates_keep_finite_weights():
    at = line()
    sure = torch.full((4, at.shape[1]), -torch.inf, dtype=torch.float64)
    sure[[0, 1, 2, 3], [10, 10, 290, 290]] = 0.0
    found = smoothed(Posterior(at, sure, 0.1), None, 0.1)
    assert found.most_likely[:, 0].round(decimals=6).tolist() == [1.0, 1.0, 29.0, 29.0]
    assert found.weight.isfinite().all()


def test_joined_groups_are_one_walk():
    at, observed = line(), walk(n=9)[1]
    whole = gaussian(at, observed)
    parts = Posterior.cat([gaussian(at, some) for some in observed.split(4)])
    assert parts.position.shape == whole.position.shape
    assert parts.log_weight.equal(whole.log_weight)
    own = Posterior.cat([gaussian(at.expand(len(some), -1, -1), some) for some in observed.split(4)])
    assert own.position.shape == (9, 301, 3)


def times(table, **options):
    time = Rssi.from_frame(table, **options).time
    return None if time is None else time.tolist()


def test_times_of_the_rows_of_a_table():
    wide = pd.DataFrame({"x": range(3), "y": 0, "time": ["2", "3.5", "7"], "hall": ["-50", "-60", "-55"]})
    assert times(wide) == [0.0, 1.5, 5.0]
    assert times(wide.assign(time=[f"2024-01-01 10:{second}" for second in ("00:00", "00:01", "01:00")])) == [0, 1, 60]
    assert times(wide.rename(columns={"time": "clock"})) is None
    assert times(wide.rename(columns={"time": "clock"}), columns={"time": "clock"}) == [0.0, 1.5, 5.0]
    assert torch.isnan(torch.tensor(times(wide.assign(time=["2", "noon", "7"])))).tolist() == [False, True, False]


def test_packets_of_one_row_have_its_time():
    long = pd.DataFrame(
        {"receiver": ["a", "b", "a", "a"], "time": [1, 1, 2, 2], "rssi": [-50, -60, -55, -56], "x": 0, "y": 0}
    )
    assert times(long) == [0.0, 1.0, 1.0]
    assert times(long.assign(time=[4, 4, 6, 6], x=[1, 1, 2, 2])) == [0.0, 2.0, 2.0]
    apart = long.assign(session=["p", "q", "q", "q"], floor=[0, 1, 1, 1])
    assert times(apart) == [0.0, 0.0, 1.0, 1.0]


def test_positions_of_a_walk(locate_run, tmp_path, capsys):
    """The transmitter rests at one position, so that the smoothed rows agree."""
    data = rssi_room(n=60)
    row = data.rssi_dbm[7] + 6 * torch.randn(10, 12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    table = pd.DataFrame(row.clamp(-149, 0).numpy(), columns=list(data.receiver_names)).assign(time=np.arange(10) / 10)
    table.to_csv(tmp_path / "walk.csv", index=False)
    tables = []
    for options in ((), ("--track", 0.1)):
        out = tmp_path / f"{len(options)}.csv"
        assert command("predict", locate_run, tmp_path / "walk.csv", *options, "--out", out) == 0
        tables.append(pd.read_csv(out))
    alone, tracked = tables
    assert list(tracked.columns) == list(alone.columns)
    assert tracked[["x_m", "y_m"]].std().sum() < 0.5 * alone[["x_m", "y_m"]].std().sum()
    assert (tracked.credible_radius_80_m <= alone.credible_radius_80_m + 0.5).all()
    capsys.readouterr()
    for speed, time, says in ((0, "3", "speed is a number above 0"), (1, "noon", "row 1 (counted from 0) has no time"),
                              (1, "", "row 1 (counted from 0) has no time")):  # fmt: skip
        table.iloc[:3].assign(time=["2", time, "7"]).to_csv(tmp_path / "walk.csv", index=False)
        walk = ("predict", locate_run, tmp_path / "walk.csv", "--track", speed, "--out", tmp_path / "out.csv")
        assert command(*walk) == 2
        assert says in capsys.readouterr().err
