"""Coverage against independent computations: one-factor integrals, distances, counts, and held-out scans."""

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib.path import Path
from pandas.testing import assert_frame_equal
from scipy.integrate import quad
from scipy.spatial.distance import cdist
from scipy.stats import norm
from test_not_detected import RECEIVER, survey

from swiftwrf import PairModel, Rssi, RssiModel, rssi_room
from swiftwrf.gp import Kernel
from swiftwrf.rssi.coverage import Coverage, default_threshold, reach
from swiftwrf.rssi.maps import RssiMap
from swiftwrf.rssi.path_loss import log_distance
from swiftwrf.rssi.scans import at_least

MEAN, STD, DETECTED = np.array([-70.0, -78.0, -74.0]), np.array([4.0, 6.0, 5.0]), np.array([0.9, 1.0, 0.6])


def at_least_by_enumeration(probability, number):
    """The probability over all outcomes of independent receivers."""
    outcomes = itertools.product((0, 1), repeat=len(probability))
    chosen = [np.array(outcome, dtype=bool) for outcome in outcomes if sum(outcome) >= number]
    return sum(np.prod(np.where(each, probability, 1 - probability)) for each in chosen)


@pytest.mark.parametrize("correlation", [0.0, 0.1, 0.6])
@pytest.mark.parametrize("number", [1, 2, 3])
def test_receivers_above_a_threshold_are_an_integral_over_the_factor_of_the_scan(number, correlation):
    score = norm.ppf(DETECTED * norm.sf(-75, MEAN, STD))

    def integrand(factor):
        given = norm.cdf((score + math.sqrt(correlation) * factor) / math.sqrt(1 - correlation))
        return norm.pdf(factor) * at_least_by_enumeration(given, number)

    found = at_least(number, *map(torch.tensor, (MEAN, STD, DETECTED)), -75.0, correlation)
    assert float(found) == pytest.approx(quad(integrand, -8, 8)[0], abs=1e-4)


def test_one_receiver_has_the_probability_of_its_normal_distribution():
    mean = torch.tensor([[-70.0, -75.0, -90.0]])
    found = at_least(1, mean, torch.full_like(mean, 4.0), torch.full_like(mean, 0.8), -75.0)
    np.testing.assert_allclose(found, 0.8 * norm.sf(-75, mean[0], 4.0), atol=1e-5)


def test_shares_are_of_the_cells_near_scans_inside_their_hull():
    generator = np.random.default_rng(0)
    x, y = np.arange(0.5, 20), np.arange(0.5, 12)
    at = generator.random((25, 2)) * (14, 9) + (2, 1)
    rssi = generator.normal(-76, 6, (25, 2))
    mean = generator.normal(-76, 8, (2, 12, 20)).astype(np.float32)
    chart = RssiMap(x, y, 1.0, 1.0, mean, np.full_like(mean, 3.0), np.full_like(mean, 0.97), ("a", "b"))
    found = Coverage.of(chart, Rssi(rssi, np.c_[at, np.ones(25)]), (-75.0, 0.9, 1), 1.7)
    cells = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    hull = Path(at[_hull(at)]).contains_points(cells)
    near = cdist(cells, at).min(axis=1) <= 1.7
    probability = found.probability.ravel()
    np.testing.assert_array_equal(found.inside.ravel(), hull)
    np.testing.assert_array_equal(found.measured.ravel(), hull & near)
    of_measured = probability[hull & near]
    expected = {
        "covered": (of_measured >= 0.9).mean(),
        "not_covered": (of_measured <= 0.1).mean(),
        "uncertain": ((of_measured > 0.1) & (of_measured < 0.9)).mean(),
        "not_measured": 1 - near[hull].mean(),
        "scans_above": (rssi.max(axis=1) > -75).mean(),
    }
    assert min(expected.values()) > 0.05
    assert {name: found.values[name] for name in expected} == pytest.approx(expected)
    assert (found.values["n_scans"], found.values["reach_m"]) == (25, 1.7)
    both = Coverage.of(chart, Rssi(rssi, np.c_[at, np.ones(25)]), (-75.0, 0.9, 2), math.inf)
    assert both.values["scans_above"] == (rssi.min(axis=1) > -75).mean()
    assert (both.measured == both.inside).all()
    assert both.values["reach_m"] is None


def flooded(cells):
    """Sets of cells (row, column) that touch each other, corners included."""
    left, areas = set(zip(*np.nonzero(cells), strict=True)), []
    while left:
        area, border = set(), [left.pop()]
        while border:
            row, column = border.pop()
            area.add((row, column))
            near = {(row + dy, column + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)} & left
            left -= near
            border += near
        areas.append(area)
    return areas


@pytest.mark.parametrize(("number", "level"), [(1, -72), (2, -66)])
def test_weak_spots_are_the_connected_cells_without_coverage(number, level):
    generator = np.random.default_rng(3)
    x, y = np.arange(0.25, 15, 0.5), np.arange(0.25, 10, 0.5)
    waves = np.stack([np.sin(x / 2 + shift) * np.cos(y[:, None] / 1.5 - shift) for shift in (0.0, 1.0, 2.5)])
    mean = (level + 9 * waves).astype(np.float32)
    std, detection = (generator.uniform(*ends, mean.shape).astype(np.float32) for ends in ((1, 3), (0.97, 1)))
    chart = RssiMap(x, y, 1.0, 0.5, mean, std, detection, ("a", "b", "c"))
    at = np.c_[generator.random((80, 2)) * (13, 8) + 1, np.ones(80)]
    coverage = Coverage.of(chart, Rssi(np.full((80, 3), -70.0), at), (-70.0, 0.9, number), 2.0)
    found = coverage.weak_spots(chart)
    above, needed = coverage.probability, np.sort(-70.0 + 1.2815515655446004 * std - mean, axis=0)[number - 1]
    expected = []
    for area in flooded(coverage.measured & (above < 0.9)):
        row, column = max(area, key=lambda cell: needed[cell])
        spot = [
            x[column],
            y[row],
            0.25 * len(area),
            0.25 * sum(above[cell] <= 0.1 for cell in area),
            above[row, column],
        ]
        order = np.argsort(-70.0 + 1.2815515655446004 * std[:, row, column] - mean[:, row, column])
        expected.append((*spot, max(needed[row, column], 0.0), "abc"[order[number - 1]]))
    expected.sort(key=lambda spot: (spot[3], spot[2]), reverse=True)
    assert len(expected) >= 2
    assert found["area_m2"].sum() > found["not_covered_m2"].sum() > 0
    for spot, wanted in zip(found.itertuples(index=False), expected, strict=True):
        assert spot[:6] == pytest.approx(wanted[:6], abs=1e-4)
        assert spot[6] == wanted[6]


def test_a_small_area_without_coverage_comes_before_a_large_uncertain_one():
    probability = np.array([[0.5] * 6 + [0.95, 0.05]])
    x, field = np.arange(8.0), np.full((1, 1, 8), -70.0, dtype=np.float32)
    chart = RssiMap(x, np.zeros(1), 1.0, 1.0, field, np.ones_like(field), np.ones_like(field), ("a",))
    measured, limits = np.ones_like(probability, dtype=bool), {"threshold_dbm": -70.0, "certainty": 0.9, "at_least": 1}
    limits |= {"direction": "above", "n_scans": 8}
    spots = Coverage(probability, measured, measured, limits).weak_spots(chart)
    assert spots[["x_m", "area_m2", "not_covered_m2"]].to_numpy().tolist() == [[7.0, 1.0, 1.0], [0.0, 6.0, 0.0]]


@pytest.mark.parametrize(
    ("names", "notes", "data", "threshold", "reason"),
    [
        (("WAP012", "WAP013"), (), "survey", -67.0, "WAP012"),
        (("ap-3",), (), "survey", -67.0, "ap-3"),
        (("aa:bb:cc:dd:ee:01",), ("taken as: x = x, y = y, receiver = bssid, RSSI = rssi",), "walk", -67.0, "bssid"),
        (("aa:bb:cc:dd:ee:01",), ("taken as: x = x, y = y, receiver = mac, RSSI = rssi",), "walk", -75.0, "no name"),
        (("a1",), (), "office-wifi", -67.0, "office-wifi"),
        (("gateway1", "apple", "lab"), (), "map", -75.0, "no name"),
    ],
)
def test_wifi_is_recognised_by_names(names, notes, data, threshold, reason):
    rows = Rssi(np.full((1, len(names)), -60.0), [[0, 0, 1]], receiver_names=names, notes=notes, name=data)
    found, why = default_threshold(rows)
    assert found == threshold
    assert reason in why


def _hull(points):
    """Corners of the convex hull by gift wrapping."""
    corners = [int(points[:, 0].argmin())]
    while len(corners) == 1 or corners[-1] != corners[0]:
        here, best = points[corners[-1]], 0
        for candidate in range(len(points)):
            (ax, ay), (bx, by) = points[best] - here, points[candidate] - here
            if (best == corners[-1]) or ax * by - ay * bx < 0:
                best = candidate
        corners.append(best)
    return corners


def test_below_a_threshold_is_the_mirror_image_of_above():
    """Coverage and weak spots are equal if map, scans and threshold change their signs."""
    generator = np.random.default_rng(7)
    x, y = np.arange(0.5, 12), np.arange(0.5, 9)
    mean, std = generator.normal(40, 12, (2, 9, 12)).astype(np.float32), np.full((2, 9, 12), 3.0, np.float32)
    at, values = np.c_[generator.random((40, 2)) * (11, 8), np.zeros(40)], generator.normal(40, 12, (40, 2))
    values[generator.random((40, 2)) < 0.2] = math.nan  # lost requests pass neither way
    found = []
    for sign in (1, -1):
        chart = RssiMap(x, y, 0.0, 1.0, sign * mean, std, np.ones_like(std), ("a", "b"), quantity="latency", unit="ms")
        scans = Rssi(sign * values, at, quantity="latency", unit="ms")
        coverage = Coverage.of(chart, scans, (sign * 45.0, 0.9, 1), 2.0, below=sign < 0)
        spots = coverage.weak_spots(chart)
        assert len(spots)
        shares = {name: value for name, value in coverage.values.items() if name not in ("threshold_dbm", "direction")}
        found.append((coverage.probability, spots, shares))
    (above, spots, shares), (below, mirrored, of_mirror) = found
    np.testing.assert_allclose(above, below)
    assert_frame_equal(spots, mirrored)
    assert shares == of_mirror
    assert shares["scans_above"] == np.mean(np.nanmax(np.c_[values, np.full(40, -999)], axis=1) > 45)


def test_a_scan_at_the_threshold_is_not_above_it():
    chart = RssiMap(np.arange(2.0), np.arange(2.0), 1.0, 1.0, *(np.ones((2, 2, 2), np.float32),) * 3, ("a", "b"))
    rows = Rssi([[-75.0, -90], [-74, -90], [math.nan, -75], [-80, -60]], np.random.default_rng(0).random((4, 3)))
    found = [Coverage.of(chart, rows, (threshold, 0.9, 1)).values["scans_above"] for threshold in (-75.0, -76.0, -90.0)]
    assert found == [0.5, 1.0, 1.0]


def test_nothing_is_measured_without_scans():
    chart = RssiMap(np.arange(3.0), np.arange(2.0), 1.0, 1.0, *(np.ones((1, 2, 3), np.float32),) * 3, ("a",))
    found = Coverage.of(chart, Rssi(np.empty((0, 1)), np.empty((0, 3))), (-75.0, 0.9, 1))
    assert not found.inside.any()
    assert found.values["covered"] is None
    assert found.values["scans_above"] is None


def test_detected_packets_between_moving_ends_have_the_map_of_all():
    """Cells are no measured pairs, but their prediction is that of a packet."""
    model = PairModel().fit(rssi_room(n=30))
    every, detected = RssiMap.of_packets(model, 4.0)
    at = np.stack([*np.meshgrid(every.x, every.y), np.full(every.mean.shape[1:], every.height)], axis=-1)
    assert np.allclose(detected.mean.reshape(12, -1).T, model.predict(at.reshape(-1, 3)).mean, atol=1e-4)
    assert np.array_equal(every.std, detected.std)
    one, rows = detected.receivers(["receiver01"]), rssi_room(n=30).receivers(["receiver01"])
    chance = norm.cdf((one.mean[0] + 75) / one.std[0])
    assert np.allclose(Coverage.of(one, rows, (-75.0, 0.9, 1)).probability, chance, atol=1e-4)


def test_a_row_at_a_receiver_that_moves_is_no_scan():
    data = rssi_room(n=30)
    chart = RssiMap.predict(PairModel().fit(data), 4.0, detected=True)
    moving = Rssi(
        data.rssi_dbm, data.transmitter_position, receiver_position=data.receiver_position, receiver_moves=True
    )
    found = Coverage.of(chart, moving, (-75.0, 0.9, 1))
    fractions = ("scans_above", "covered", "uncertain", "not_covered", "not_measured")
    assert [found.values[name] for name in ("n_scans", *fractions)] == 6 * [None]
    assert not len(found.weak_spots(chart))


@pytest.mark.parametrize("noise", [0.3, 1.0, 2.0, 3.0])
def test_at_the_reach_half_of_the_field_is_open_or_the_interval_is_a_fifth_wider(noise):
    kernel = Kernel(7.0, matern12_weight=1.0, noise=noise)
    found = reach(SimpleNamespace(kernel=kernel))
    cells = torch.tensor([[0.0, 0, 0], [min(found, 1e6), 0, 0]], dtype=torch.float64)
    covariance = kernel(cells, cells).numpy()
    is_open = covariance[1, 1] - covariance[0, 1] ** 2 / covariance[0, 0]  # variance given the field at the scan
    wider = math.sqrt((noise + is_open) / noise)
    if math.isfinite(found):
        assert is_open == pytest.approx(0.5, abs=1e-6) or wider == pytest.approx(1.2, abs=1e-6)
    assert is_open <= 0.5 + 1e-6 or wider <= 1.2 + 1e-6
    assert math.isinf(found) == (noise == 3.0)


def test_a_model_without_a_field_is_determined_everywhere():
    model = RssiModel().fit(rssi_room(n=60))
    assert math.isfinite(reach(model))
    model.field_db = torch.zeros_like(model.field_db)
    assert math.isinf(reach(model))
    assert reach(PairModel().fit(rssi_room(n=30))) > 0


def test_a_packet_counts_if_it_is_detected_and_above():
    """Against the true power of a survey, a fifth of whose packets are lost at any power; the limit is at -88 dBm."""
    data, _ = survey(n=400, missed=0.2)
    chart = RssiMap.predict(RssiModel().fit(data), detected=True)
    at = np.stack([*np.meshgrid(chart.x, chart.y), np.ones(chart.mean.shape[1:])], axis=-1).reshape(-1, 3)
    truth = -42 - 38 * log_distance(torch.tensor(at), RECEIVER).numpy() + 3 * np.sin(at[:, :1] / 4 + np.arange(4))
    for threshold, cells in ((-75.0, truth > -200), (-87.0, truth > -200), (-87.0, abs(truth + 88) < 3)):
        found = [
            Coverage.of(chart.receivers([name]), data.columns([number]), (threshold, 0.9, 1)).probability.ravel()
            for number, name in enumerate(chart.receiver_names)
        ]
        expected = 0.8 * norm.sf(threshold, truth, 2.0)
        assert np.stack(found, axis=1)[cells].mean() == pytest.approx(expected[cells].mean(), abs=0.025)


def test_unknown_positions_of_receivers_leave_the_coverage_as_it_is():
    known = rssi_room(n=120)
    unknown = replace(known, receiver_position=torch.full_like(known.receiver_position, torch.nan))
    for data in (known, unknown):
        chart = RssiMap.predict(RssiModel().fit(data), 1.0, detected=True)
        assert Coverage.of(chart, data, (-75.0, 0.9, 1)).values["covered"] > 0.99


def test_coverage_of_receivers_with_common_errors_is_that_of_counted_scans():
    """Six networks of one access point: 0.2 as correlation predicts 6 points or more too many scans."""
    generator = np.random.default_rng(5)
    at = np.c_[generator.random((600, 2)) * (30, 12), np.ones(600)]
    power = -40 - 25 * np.log10(np.hypot(at[:, 0] - 5, at[:, 1] - 6) + 1) + generator.normal(0, 4.5, 600)
    rows = Rssi(power[:, None] + generator.normal(0, 2.5, (600, 6)), at)
    train, test = rows.subset(torch.arange(400)), rows.subset(torch.arange(400, 600))
    model = RssiModel().fit(train)
    assert model.scan_correlation >= 0.6
    found = model.predict_detected(test)
    fields = found.mean.T, found.std.T, torch.ones_like(found.mean.T)
    passed = (test.rssi_dbm > -65).any(dim=1).double().mean()
    chosen, usual = (float(at_least(1, *fields, -65.0, rho).mean() - passed) for rho in (model.scan_correlation, 0.2))
    assert abs(chosen) < 0.05
    assert usual > 0.06
    chart = RssiMap.predict(model, 2.0, detected=True)
    expected = at_least(1, *map(torch.tensor, (chart.mean, chart.std, chart.detection)), -65.0, model.scan_correlation)
    np.testing.assert_allclose(Coverage.of(chart, train, (-65.0, 0.9, 1)).probability, expected)


def test_held_out_scans_pass_as_predicted():
    """At thresholds that half to nine tenths of the scans pass, on floors that the correlation was not chosen by."""
    predicted, passed = [], []
    for seed in range(100, 104):
        train, test = rssi_room(n=400, seed=seed).split()
        model = RssiModel().fit(train)
        strongest = test.rssi_dbm.nan_to_num(-torch.inf).amax(dim=1)
        fields = (model.predict_detected(test).mean.T, model.predict_detected(test).std.T)
        detection = model.predict_detection(test.transmitter_position).T
        for quantile in (0.1, 0.3, 0.5):
            threshold = float(strongest.quantile(quantile)) - 0.5
            predicted.append(at_least(1, *fields, detection, threshold, model.scan_correlation).numpy())
            passed.append((strongest > threshold).numpy())
    predicted, passed = np.stack(predicted), np.stack(passed)
    expected = passed.mean(axis=1).reshape(-1, 3).mean(axis=0)  # of all floors
    np.testing.assert_allclose(predicted.mean(axis=1).reshape(-1, 3).mean(axis=0), expected, atol=0.05)
    assert passed[predicted > 0.9].mean() >= 0.85
