"""Plans of access points in a hall of known coverage."""

import numpy as np
import pytest
import torch

from swiftwrf import InputError, Rssi, RssiModel
from swiftwrf.contrib.survey.plan import interval, plan_coverage

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


def test_what_cannot_be_planned_is_refused(hall):
    model, data = hall
    with pytest.raises(InputError, match="no receiver 'nowhere'"):
        plan_coverage(model, data, off=["nowhere"])
    with pytest.raises(InputError, match="2 access points cannot be chosen among 1 candidates"):
        plan_coverage(model, data, 2, candidates=[(1.0, 1.0, 1.0)])
