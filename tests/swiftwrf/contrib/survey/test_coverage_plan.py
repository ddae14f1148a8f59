"""Plans of access points in a hall of known coverage."""

import numpy as np
import pytest
import torch
from scipy.stats import norm

from swiftwrf import InputError, Rssi, RssiModel
from swiftwrf.contrib.survey import plan as module
from swiftwrf.contrib.survey.plan import interval, plan_coverage
from swiftwrf.contrib.survey.receivers import SharedPathLoss
from swiftwrf.data.coordinates import Floors
from swiftwrf.rssi.path_loss import log_distance

LEVEL, SLOPE, NOISE_DB = -40.0, -30.0, 3.0


def survey(*receiver, n=300, seed=0):
    """Return a walk of a hall of 40 x 20 m whose RSSI is a path loss and noise."""
    draw = np.random.default_rng(seed)
    position = np.column_stack([draw.uniform(0, 40, n), draw.uniform(0, 20, n), np.full(n, 1.2)])
    at = np.array(receiver)
    rssi = (
        LEVEL
        + SLOPE * np.log10(np.linalg.norm(position[:, None] - at, axis=2))
        + draw.normal(0, NOISE_DB, (n, len(at)))
    )
    names = [f"ap{number}" for number in range(1, len(at) + 1)]
    return Rssi(rssi, position, receiver_position=at, receiver_names=names, name="hall")


def true_coverage(above_dbm, *receiver):
    """Return the share of scans in the hall with a receiver above a threshold."""
    x, y = np.meshgrid(np.linspace(0.5, 39.5, 80), np.linspace(0.5, 19.5, 40))
    cells = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1.2)])
    mean = LEVEL + SLOPE * np.log10(np.linalg.norm(cells[:, None] - np.array(receiver), axis=2))
    return 1 - float((1 - torch.special.ndtr(torch.tensor(mean - above_dbm) / NOISE_DB)).prod(dim=1).mean())


WEST = (5.0, 10.0, 2.5), (10.0, 4.0, 2.5), (9.0, 16.0, 2.5)


@pytest.fixture(scope="module")
def hall():
    data = survey(*WEST)
    return RssiModel().fit(data), data


def test_the_gain_is_that_of_a_simulated_access_point(hall):
    model, data = hall
    places = [(30.0, 10.0, 2.5), (15.0, 10.0, 2.5), (38.0, 1.0, 2.5)]
    found = plan_coverage(model, data, 1, above_dbm=-70, candidates=places)
    before = true_coverage(-70, *WEST)
    gains = [true_coverage(-70, *WEST, place) - before for place in places]
    mean, low, high = interval(found.gain)
    assert float(found.measured.mean()) == pytest.approx(before, abs=0.04)
    np.testing.assert_allclose(mean, gains, atol=0.07)
    assert all(start < gain < end for start, gain, end in zip(low.tolist(), gains, high.tolist(), strict=True))
    assert found.chosen == (int(np.argmax(gains)),) == (0,)


def test_two_access_points_are_chosen_one_after_the_other(hall):
    model, data = hall
    found = plan_coverage(model, data, 2, above_dbm=-62)
    first, second = found.candidates[list(found.chosen)]
    assert first[0] > 20
    assert second[0] > 15
    assert float((first - second)[:2].norm()) > 6
    assert bool((found.after[0] >= found.before).all())
    assert bool((found.after[1] >= found.after[0]).all())
    inner = found.candidates[:, :2]
    assert bool(((inner >= 0) & (inner <= torch.tensor([40.0, 20.0]))).all())


def test_an_access_point_switched_off_or_louder_changes_the_coverage(hall):
    model, data = hall
    off = plan_coverage(model, data, 0, above_dbm=-62, off=["ap1"])
    assert float(off.measured.mean() - off.before.mean()) == pytest.approx(
        true_coverage(-62, *WEST) - true_coverage(-62, *WEST[1:]), abs=0.03
    )
    louder = plan_coverage(model, data, 0, above_dbm=-62, power_db={"ap1": 6.0, "ap2": 6.0, "3": 6.0})
    assert float(louder.before.mean()) == pytest.approx(true_coverage(-68, *WEST), abs=0.04)
    assert not louder.chosen


def test_a_moved_access_point_is_switched_off_and_added(hall):
    model, data = hall
    place = (30.0, 10.0, 2.5)
    found = plan_coverage(model, data, 1, above_dbm=-65, off=["ap2"], candidates=[place])
    true = true_coverage(-65, WEST[0], WEST[2], place)
    assert float(found.after[0].mean()) == pytest.approx(true, abs=0.06)


def test_positions_that_are_unknown_are_estimated_first(hall):
    _, data = hall
    unknown = data.derived(receiver_position=torch.full((3, 3), torch.nan))
    found = plan_coverage(RssiModel().fit(unknown), unknown, 1, above_dbm=-62)
    assert float(found.candidates[found.chosen[0], 0]) > 20


def shadowed_hall(lost, n=250):
    """Return a walk of a hall with shadowing in common of three receivers, and of each alone; some packets are lost."""
    draw = np.random.default_rng(5)
    position = np.column_stack([draw.uniform(0, 40, n), draw.uniform(0, 20, n), np.full(n, 1.2)])
    apart = np.linalg.norm(position[:, None] - position, axis=2)
    factor = np.linalg.cholesky(np.exp(-apart / 6) + 1e-9 * np.eye(n))
    field = 7 * factor @ draw.normal(size=(n, 1)) + 3 * factor @ draw.normal(size=(n, 3))
    distance = np.linalg.norm(position[:, None] - np.array(WEST), axis=2)
    rssi = LEVEL + SLOPE * np.log10(distance) + field + draw.normal(0, 1, (n, 3))
    rssi[draw.random(rssi.shape) < lost] = np.nan
    return Rssi(rssi, position, receiver_position=np.array(WEST), receiver_names=["ap1", "ap2", "ap3"])


@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_a_further_access_point_has_the_path_loss_and_the_shadowing_of_the_survey(lost, monkeypatch):
    """Coverage of one alone, all others off, against samples of path loss and conditional shadowing in plain NumPy."""
    monkeypatch.setattr(module, "N_SAMPLES", 2000)
    monkeypatch.setattr(module, "N_CELLS", 60)
    data, place = shadowed_hall(lost), np.array([30.0, 10.0, 2.5])
    model = RssiModel().fit(data)
    found = plan_coverage(model, data, 1, above_dbm=-75, candidates=place[None], off=data.receiver_names)
    shared = SharedPathLoss.fit(data, data.receiver_position)
    assert shared.common_db > 2
    cells, draw = found.cells.numpy(), np.random.default_rng(0)
    residual = (
        model.predict(cells).mean.numpy() - shared.each(log_distance(found.cells, data.receiver_position)).numpy()
    )
    # the part in common of variance v, given three sums of it and parts of variance w
    v, w = shared.common_db**2, shared.field_db**2 - shared.common_db**2
    covariance = v * np.ones((3, 3)) + w * np.eye(3)
    gain = np.linalg.solve(covariance, v * np.ones(3))
    mean, std = residual @ gain, np.sqrt(w + v - v * gain.sum())
    correlation = shared.kernel(found.cells, found.cells).numpy() + 1e-6 * np.eye(len(cells))
    field = mean + std * draw.normal(size=(2000, len(cells))) @ np.linalg.cholesky(correlation).T
    level, slope = (np.array([shared.level, shared.slope]) + draw.normal(size=(2000, 2)) @ shared.root.numpy().T).T
    power = level[:, None] + np.minimum(slope, 0)[:, None] * np.log10(np.linalg.norm(cells - place, axis=1)) + field
    received = 1.0 if model.detection is None else 1 - float(model.detection.missed.median())
    assert received == pytest.approx(1 - lost, abs=0.06)
    above = received * norm.cdf((power + 75) / shared.noise_db)
    share = above.mean(axis=1)
    assert float(found.before.max()) == 0
    after = found.after[0].numpy()
    assert after.mean() == pytest.approx(share.mean(), abs=0.02)
    np.testing.assert_allclose(np.quantile(after, (0.1, 0.9)), np.quantile(share, (0.1, 0.9)), atol=0.03)
    assert np.abs(found.probability[1].numpy() - above.mean(axis=0)).mean() < 0.007


def test_coverage_gain_and_probability_are_of_the_same_samples(hall):
    model, data = hall
    found = plan_coverage(model, data, 2, above_dbm=-64, off=["ap1"])
    torch.testing.assert_close(found.gain[found.chosen[0]], found.after[0] - found.before)
    means = found.probability.mean(dim=1)
    torch.testing.assert_close(means, torch.stack([found.before.mean(), found.after[-1].mean()]))


def test_the_interval_of_samples_has_ten_percent_on_each_side():
    samples = torch.arange(101, dtype=torch.float64)[torch.randperm(101, generator=torch.Generator().manual_seed(0))]
    assert [float(value) for value in interval(samples)] == pytest.approx([50, 10, 90])


def test_a_place_is_chosen_once(hall):
    model, data = hall
    places = [(30.0, 10.0, 2.5), (31.0, 10.0, 2.5), (5.0, 10.0, 2.5)]
    assert sorted(plan_coverage(model, data, 3, above_dbm=-62, candidates=places).chosen) == [0, 1, 2]


def test_a_floor_takes_power_from_an_access_point_on_another_one():
    """Two floors of which only the lower one has a receiver: above it is a hole, which a place there fills."""
    draw, n = np.random.default_rng(2), 400
    floor = np.arange(n) % 2
    position = np.column_stack([draw.uniform(0, 30, n), draw.uniform(0, 15, n), 1.2 + 4.0 * floor])
    at = np.array([[5.0, 7.0, 2.5], [25.0, 7.0, 2.5]])
    distance = np.linalg.norm(position[:, None] - at, axis=2)
    rssi = LEVEL + SLOPE * np.log10(distance) - 18 * floor[:, None] + draw.normal(0, NOISE_DB, (n, 2))
    floors = Floors(("ground", "first"), (1.2, 5.2))
    data = Rssi(rssi, position, receiver_position=at, receiver_names=["a", "b"], floors=floors)
    model = RssiModel().fit(data)
    assert model.attenuation.db == pytest.approx(18, abs=3)
    found = plan_coverage(model, data, 1, above_dbm=-66, candidates=[(15.0, 7.0, 2.5), (15.0, 7.0, 6.5)])
    below, above = found.gain.mean(dim=1).tolist()
    assert found.chosen == (1,)
    assert above > below + 0.1


def test_a_hole_comes_before_the_edge_of_a_covered_area():
    """A small room without coverage, and a hall six times as large where half of the scans pass."""
    draw, n = np.random.default_rng(4), 500
    position = np.column_stack([draw.uniform(0, 50, n), draw.uniform(0, 10, n), np.full(n, 1.2)])
    hall = position[:, 0] < 43
    rssi = np.where(hall, -70.0, -95.0) + draw.normal(0, NOISE_DB, n)
    at = np.array([[20.0, 5.0, 2.5]])
    data = Rssi(rssi[:, None], position, receiver_position=at, receiver_names=["a"])
    found = plan_coverage(
        RssiModel().fit(data), data, 1, above_dbm=-70, candidates=[(20.0, 5.0, 2.5), (46.0, 5.0, 2.5)]
    )
    assert found.chosen == (1,)
    assert float(found.gain[0].mean()) > float(found.gain[1].mean())


def test_what_cannot_be_planned_is_refused(hall):
    model, data = hall
    with pytest.raises(InputError, match="no receiver 'nowhere'"):
        plan_coverage(model, data, off=["nowhere"])
    with pytest.raises(InputError, match="2 access points cannot be chosen among 1 candidates"):
        plan_coverage(model, data, 2, candidates=[(1.0, 1.0, 1.0)])
