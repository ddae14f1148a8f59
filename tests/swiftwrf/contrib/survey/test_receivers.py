"""Positions of receivers that a survey does not state."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from swiftwrf import InputError, Rssi, load_rssi, rssi_room
from swiftwrf.contrib.survey import receivers as module
from swiftwrf.contrib.survey.receivers import (
    SharedPathLoss,
    _Evidence,
    locate_receivers,
    strongest_rows,
    weighted_centroids,
)
from swiftwrf.data.coordinates import Floors
from swiftwrf.gp import Kernel
from swiftwrf.rssi.path_loss import PathLoss, harmonics


def hidden(data, known=()):
    """Return data without the positions of receivers, except those of some columns."""
    position = torch.full_like(data.receiver_position, torch.nan)
    position[list(known)] = data.receiver_position[list(known)]
    return data.derived(receiver_position=position)


def in_plan(found, truth):
    return (found - truth)[:, :2].norm(dim=1)


@pytest.fixture(scope="module")
def floor():
    data = rssi_room(seed=3)
    return data, locate_receivers(hidden(data))


def test_receivers_of_a_simulated_floor_are_found(floor):
    data, found = floor
    error = in_plan(found.position, data.receiver_position)
    assert float(error.median()) < 1.5
    assert float(error.median()) < 0.5 * float(in_plan(found.centroid, data.receiver_position).median())
    assert int((error <= found.radius_m).sum()) >= 9


def test_the_region_holds_80_percent_of_the_mass(floor):
    _, found = floor
    away = (found.posterior.position[..., :2] - found.position[:, None, :2]).norm(dim=2)
    held = (found.posterior.weight * (away <= found.radius_m[:, None])).sum(dim=1)
    assert bool((held >= 0.8).all())
    shrunk = (found.posterior.weight * (away <= found.radius_m[:, None] - 2 * found.posterior.resolution_m)).sum(dim=1)
    assert bool((shrunk < 0.85).all())


def test_the_likelihood_is_that_of_a_normal_vector():
    """The integral over the coefficients is the density with their covariance added, up to one constant."""
    torch.manual_seed(0)
    at, rssi = 9 * torch.rand(14, 3, dtype=torch.float64), -50 - 10 * torch.rand(14, dtype=torch.float64)
    count = torch.tensor([1.0, 2.0] * 7, dtype=torch.float64)
    root = torch.tensor([[5.0, -3.0], [0.0, 4.0]], dtype=torch.float64)
    model = SharedPathLoss(
        PathLoss(*root), -40.0, -22.0, root, Kernel(3.0, matern12_weight=1.0, noise=1.0), 3.0, 2.0, 0.0
    )
    candidate = 9 * torch.rand(5, 3, dtype=torch.float64)
    found = _Evidence(at, rssi, count).log_likelihood(candidate, model)
    wanted = []
    for q in candidate:
        distance = (at - q).norm(dim=1).log10()
        trend = torch.stack([torch.ones(14), distance], dim=1) @ root
        feature = torch.cat([trend, harmonics(at, q[None])[:, 0]], dim=1)
        covariance = 9.0 * torch.exp(-torch.cdist(at, at) / 3.0) + (4.0 / count).diag() + feature @ feature.T
        normal = torch.distributions.MultivariateNormal(-40.0 - 22.0 * distance, covariance)
        wanted.append(normal.log_prob(rssi))
    difference = found - torch.stack(wanted)
    torch.testing.assert_close(difference, difference[:1].expand(5))


def test_a_receiver_beside_the_walk_is_outside():
    """A walk of 20 m, 8 m from the receiver: no row is nearer, and the power falls on both sides."""
    x, y = np.meshgrid(np.linspace(0, 20, 41), [0.0, 1.0, 2.0])
    position = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    distance = np.hypot(position[:, 0] - 12.0, position[:, 1] - 10.0)
    noise = np.random.default_rng(0).normal(0, 1.5, x.size)
    data = Rssi((-40 - 25 * np.log10(distance) + noise)[:, None], position)
    found = locate_receivers(data)
    assert bool(found.is_outside[0])
    assert abs(float(found.position[0, 0]) - 12.0) < 2.0


def test_known_receivers_determine_the_weight():
    data = rssi_room(n=200, seed=1)
    found = locate_receivers(hidden(data, range(2, 12)))
    assert found.names == ("receiver01", "receiver02")
    assert found.weight != module.DEFAULT_WEIGHT
    assert 0.1 <= found.weight <= 1.0


def test_the_table_is_read_as_positions_of_receivers(tmp_path):
    data = rssi_room(n=80).columns([0, 1])
    hidden(data).to_frame().rename(columns=lambda name: name.removesuffix("_m")).to_csv(tmp_path / "walk.csv")
    read = load_rssi(tmp_path / "walk.csv", columns={"rssi": "receiver*"})
    found = locate_receivers(read)
    found.to_frame().to_csv(tmp_path / "receivers.csv", index=False)
    again = load_rssi(tmp_path / "walk.csv", columns={"rssi": "receiver*"})
    np.testing.assert_allclose(again.receiver_position, found.position, atol=0.01)


def test_pixels_of_a_floor_plan_are_given_back_as_pixels(tmp_path):
    """A plan of 20 pixels in a metre, whose y goes down."""
    data = rssi_room(n=80).columns([0, 1])
    table = hidden(data).to_frame().rename(columns=lambda name: name.removesuffix("_m"))
    table.assign(x=20 * table["x"], y=-20 * table["y"]).to_csv(tmp_path / "walk.csv")
    options = {"columns": {"rssi": "receiver*"}, "scale": 20.0, "y_down": True}
    found = locate_receivers(load_rssi(tmp_path / "walk.csv", **options))
    assert float((found.position - data.receiver_position)[:, :2].norm(dim=1).max()) < 4.0
    found.to_frame().to_csv(tmp_path / "receivers.csv", index=False)
    again = load_rssi(tmp_path / "walk.csv", **options)
    np.testing.assert_allclose(again.receiver_position[:, :2], found.position[:, :2], atol=0.01)


def test_baselines_are_the_strongest_row_and_the_mean_weighted_by_power():
    data = rssi_room(n=60).columns([3])
    rssi, at = data.rssi_dbm[:, 0].numpy(), data.transmitter_position.numpy()
    power = np.where(np.isnan(rssi), 0.0, np.power(10.0, np.nan_to_num(rssi) / 10))
    np.testing.assert_allclose(weighted_centroids(data)[0], (power[:, None] * at).sum(axis=0) / power.sum())
    np.testing.assert_array_equal(strongest_rows(data)[0], at[np.nanargmax(rssi)])


def test_a_receiver_is_on_the_floor_of_its_strongest_mean():
    """Two floors 4 m apart that take 15 dB; a receiver on each."""
    draw, n = np.random.default_rng(0), 300
    storey = np.arange(n) % 2
    position = np.column_stack([draw.uniform(0, 20, n), draw.uniform(0, 12, n), 1.0 + 4.0 * storey])
    at, of = np.array([[5.0, 5.0, 2.0], [15.0, 8.0, 6.0]]), np.array([0, 1])
    distance = np.linalg.norm(position[:, None] - at, axis=2)
    rssi = -40 - 25 * np.log10(distance) - 15 * (storey[:, None] != of) + draw.normal(0, 2, (n, 2))
    found = locate_receivers(Rssi(rssi, position, floors=Floors(("0", "1"), (1.0, 5.0))))
    assert [0 <= float(z) - low <= 2 for z, low in zip(found.position[:, 2], (1.0, 5.0), strict=True)] == [True, True]


@pytest.mark.parametrize(("mass", "is_outside"), [(0.04, False), (0.45, False), (0.55, True)])
def test_outside_is_more_probable_than_inside(floor, mass, is_outside):
    _, found = floor
    assert bool(replace(found, outside=torch.tensor([mass])).is_outside) is is_outside


def test_data_without_an_unknown_position_are_refused():
    with pytest.raises(InputError, match="no receiver of simulated-floor has an unknown position"):
        locate_receivers(rssi_room(n=40))
    with pytest.raises(InputError, match="6 places"):
        locate_receivers(hidden(rssi_room(n=5)))
