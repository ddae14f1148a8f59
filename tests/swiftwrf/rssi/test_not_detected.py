"""Empty cells as upper limits: against a truth that is known below the limit of detection."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from small import only
from test_floors import FLOOR_DB, RECEIVERS, building, rssi

from swiftwrf import Rssi, RssiModel, load_rssi, rssi_room
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.data.rssi import Offsets
from swiftwrf.gp import Kernel
from swiftwrf.rssi import compare
from swiftwrf.rssi.detection import Detection, DetectionField
from swiftwrf.rssi.head import Heads
from swiftwrf.rssi.offsets import estimate_floor_attenuation
from swiftwrf.rssi.path_loss import fit_path_losses, log_distance
from swiftwrf.rssi.regression import solve
from swiftwrf.testing import check_saved

LIMIT = -88.0
RECEIVER = torch.tensor([[3.0, 3, 2], [27, 4, 2], [15, 18, 2], [5, 15, 2]], dtype=torch.float64)


def survey(n=150, limit=LIMIT, missed=0.0, seed=0, packet_db=2.0):
    """Path loss, a smooth field and noise at four receivers, and what is below the limit missing; with the true power."""
    generator = torch.Generator().manual_seed(seed)
    position = torch.tensor([0.0, 0, 1]) + torch.rand(n, 3, generator=generator).double() * torch.tensor([30.0, 20, 0])
    truth = -42.0 - 38.0 * log_distance(position, RECEIVER) + 3 * torch.sin(position[:, :1] / 4 + torch.arange(4))
    rssi = truth + packet_db * torch.randn(n, 4, generator=generator)
    lost = (rssi < limit) | (torch.rand(n, 4, generator=generator) < missed)
    data = Rssi(
        rssi.where(~lost, torch.nan), position, receiver_position=RECEIVER, receiver_names=list("abcd"), name="s"
    )
    return data, truth


def test_maps_below_the_limit_have_the_noise_of_packets():
    """Values above the limit vary less than all, so with a tenth of the noise weak cells are predicted too strong."""
    data, _ = survey(packet_db=0.3)
    assert RssiModel(not_detected="weak").fit(data).kernel.noise >= 0.3
    assert RssiModel(not_detected="unknown").fit(data).kernel.noise < 0.3


def test_small_noises_alone_leave_a_field_where_empty_cells_are_limits():
    data, _ = survey(packet_db=0.3)
    model = RssiModel(not_detected="weak", noises=(0.03, 0.1)).fit(data)
    assert model.kernel.noise == 0.1
    assert bool(model.field_db.any())


@pytest.fixture(scope="module")
def fitted():
    data, truth = survey()
    return data, truth, RssiModel().fit(data)


def test_the_map_is_weak_where_nothing_was_received_and_elsewhere_as_good_as_without_empty_cells(fitted):
    data, truth, model = fitted
    ignoring = RssiModel(not_detected="unknown").fit(data)
    mean, other = (one.predict(data.transmitter_position).mean for one in (model, ignoring))
    weak, strong = truth < LIMIT - 3, truth > LIMIT + 3
    assert int(weak.sum()) > 50
    assert float((mean - truth)[weak].mean()) < 3.5
    assert float((mean > LIMIT)[weak].double().mean()) < 0.05
    assert float((other - truth)[weak].mean()) > 1.5 * float((mean - truth)[weak].mean())
    assert float((mean - truth)[strong].abs().mean()) < float((other - truth)[strong].abs().mean()) + 0.05


def test_a_detected_value_is_predicted_above_the_power_of_all_packets(fitted):
    data, _, model = fitted
    every, detected = model.predict(data.transmitter_position), model.predict_detected(data)
    weak = every.mean < LIMIT
    assert bool((detected.mean >= every.mean - 1e-4).all())
    assert bool((detected.mean > every.mean + 1)[weak].all())
    assert bool((detected.std <= every.std + 1e-4).all())


def test_the_limit_and_random_misses_are_told_apart():
    data, _ = survey(n=400, missed=0.2)
    found = Detection.estimate(data.transmitter_position, data.rssi_dbm)
    assert found.limit.tolist() == pytest.approx([LIMIT] * 4, abs=2)
    assert float(found.missed.mean()) == pytest.approx(0.2, abs=0.07)
    assert Detection.estimate(data.transmitter_position, data.rssi_dbm.nan_to_num(-90.0)) is None


@pytest.mark.parametrize("not_detected", ["auto", "weak"])
def test_receivers_of_other_sensitivity_have_limits_of_their_own(not_detected):
    """With one limit, that of the sensitive receivers, no empty cell of the others is explained: +5.3 dB, 42 % covered."""
    limit, errors, inside = torch.tensor([-95.0, -95.0, -72.0, -72.0]), [], []
    for seed in range(5):
        random = np.random.default_rng(seed)
        position, receiver = (torch.from_numpy(random.uniform(0, 40, (n, 3)) * [1, 1, 0.05]) for n in (160, 4))
        packet = -40 - 27 * log_distance(position, receiver) + torch.from_numpy(random.normal(0, 4, (160, 4)))
        data = Rssi(packet.where(packet >= limit, torch.nan), position, receiver_position=receiver)
        model = RssiModel(not_detected=not_detected).fit(data.subset(torch.arange(110)))
        assert float((model.detection.limit - limit)[2:].abs().max()) < 4
        found = model.predict(position[110:])
        low, high = found.interval(0.8)
        empty = packet[110:] < limit
        errors.append((found.mean - packet[110:])[empty])
        inside.append(((low <= packet[110:]) & (packet[110:] <= high))[empty])
    assert float(torch.cat(errors).mean()) < 2
    assert 0.65 < float(torch.cat(inside).double().mean()) < 0.9
    curve = Detection(limit.double(), 1.0, torch.zeros(4), torch.ones(4, dtype=torch.bool))
    assert curve.note(list("abcd")) == "an empty cell means that the signal was below about -95 to -72 dBm"


def test_empty_cells_that_are_weak_are_no_random_misses_however_many_there_are():
    """The share of misses counts all cells: of the other ones alone, it would grow from any beginning."""
    data, _ = survey(limit=-76.0)
    assert 0.6 < float((~data.detected).double().mean()) < 0.9
    found = fit_path_losses(data.transmitter_position, RECEIVER, data.rssi_dbm)
    assert found.detection.is_limit.all()
    assert float((found.each.slope + 38).abs().max()) < 8


def test_few_values_among_many_rows_are_enough():
    position = torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)).double()
    rssi = torch.full((5000, 2), torch.nan).double()
    rssi[101:103] = -70.0  # between the rows of an even sample
    assert Detection.estimate(position, rssi).limit.tolist() == [-70, -70]


@pytest.mark.parametrize("is_detected", [True, False])
def test_one_cell_of_its_kind_among_many_is_enough(is_detected):
    position = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)).double()
    detected = torch.full((300, 100), not is_detected)
    detected[3, 2] = is_detected
    kernel, level = Kernel(1.0, matern12_weight=1.0, noise=1.0), torch.full((300, 100), -60.0).double()
    found, _ = DetectionField.fit(kernel, position, detected, torch.arange(300) % 5, level, torch.full((100,), -90.0))
    probability = found.probability(level, position)
    assert bool(((probability > 0.5) == detected).double().mean() > 0.999)


def test_a_receiver_that_is_empty_beside_its_place_keeps_its_path_loss():
    """It was off, so its empty cells are no limits; those of the others are."""
    data, _ = survey()
    rssi = data.rssi_dbm.clone()
    near = log_distance(data.transmitter_position, RECEIVER)[:, 0] < 1.1
    rssi[near, 0] = torch.nan
    rssi[(~near).nonzero()[::2, 0], 0] = torch.nan
    found = fit_path_losses(data.transmitter_position, RECEIVER, rssi)
    assert found.detection.is_limit.tolist() == [False, True, True, True]
    assert "at 1 of 4 receivers (a) empty cells say nothing" in found.detection.note(list("abcd"))
    assert float(found.each.slope[0]) < -25
    asked = [fit_path_losses(data.transmitter_position, RECEIVER, rssi, kind) for kind in ("weak", "unknown")]
    assert asked[0].detection.is_limit.all()
    assert asked[1].detection is None


def test_a_receiver_seen_at_one_distance_has_the_slope_of_all():
    """Least squares of its own rows gives +100 dBm beside it."""
    data, _ = survey(limit=-200.0)
    rssi, apart = data.rssi_dbm.clone(), 10 ** log_distance(data.transmitter_position, RECEIVER)[:, 0]
    rssi[(apart < 12) | (apart > 13), 0] = torch.nan
    assert 3 < int((~rssi[:, 0].isnan()).sum()) < 20
    model = RssiModel(not_detected="unknown").fit(replace(data, rssi_dbm=rssi))
    line = RECEIVER[0] + torch.tensor([[1.0, 0, -1], [4, 0, -1], [12.5, 0, -1]]).double()
    found, truth = model.predict(line), -42 - 38 * log_distance(line, RECEIVER)[:, 0]
    assert float((found.mean[:, 0] - truth).abs().max()) < 6
    assert float(found.std[0, 0]) > float(found.std[2, 0]) + 0.5  # the trend is uncertain far from the rows


@pytest.mark.data
def test_empty_cells_that_make_held_out_values_unlikely_are_no_limits(measured_data):
    """A receiver of this building misses strong packets on whole days; limits cost 1.1 dB of the median."""
    train, test = load_rssi(measured_data / "ts-ujib1").columns(range(0, 16, 4)).split("published")
    models = {kind: RssiModel(not_detected=kind).fit(train) for kind in ("weak", "unknown", "auto")}
    error = {
        kind: float((model.predict_detected(test).mean - test.rssi_dbm)[test.detected].abs().median())
        for kind, model in models.items()
    }
    assert error["auto"] < error["unknown"] + 0.1 < error["weak"] - 0.5
    assert models["weak"].detection.is_limit.all()
    assert "here empty cells say nothing" in models["auto"].detection.note(train.receiver_names)
    # the probability of a detection is that of the rows nearby
    probability = models["auto"].predict_detection(test.transmitter_position)
    assert float(probability[test.detected].mean()) > float(probability[~test.detected].mean()) + 0.1


@only(RSSI_PREDICTORS, "swiftwrf", "mean")
def test_detections_are_predicted_and_scored(fitted):
    data, _, model = fitted
    found = compare(data, split="random")
    score = found.summary()["detection"]
    assert float(score["swiftwrf"]) > 0.85
    assert float(score["swiftwrf"]) > float(score["mean"])
    test, errors = found.test, found.errors.groupby("method")["abs_error_db"]
    above = found.predictors["swiftwrf"].predict_detection(test.transmitter_position).numpy() > 0.5
    detected = test.detected.numpy()
    assert found.values["swiftwrf"]["detection"] == pytest.approx((above[detected].mean(), 1 - above[~detected].mean()))
    assert found.values["mean"]["median"] == pytest.approx(errors.median()["mean"])
    probability = model.predict_detection(data.transmitter_position)
    assert float(probability[data.detected].mean()) > 0.9 > 0.2 > float(probability[~data.detected].mean())
    full = replace(data, rssi_dbm=data.rssi_dbm.nan_to_num(-90.0))
    assert bool((RssiModel().fit(full).predict_detection(data.transmitter_position) == 1).all())
    assert "detection" not in compare(full, split="random", validation="block").summary()


def test_empty_cells_do_not_outweigh_the_few_values_of_a_receiver():
    """A phone that passed is not weak where it was not received."""
    data = replace(survey()[0], receiver_position=torch.full((4, 3), torch.nan).double())
    passed = torch.arange(len(data)) % 20 == 0
    data.rssi_dbm[:, 3] = torch.where(passed, -65.0, torch.nan)
    model = RssiModel().fit(data.subset((torch.arange(len(data)) % 40 != 0).nonzero()[:, 0]))
    assert float((model.predict_detected(data).mean[passed, 3] + 65).abs().mean()) < 7  # 21 dB with the limits


def test_a_saved_and_updated_model_keeps_its_detections(fitted):
    data, _, model = fitted
    more = survey(n=20, seed=1)[0]
    for learnt in (lambda saved: saved, lambda saved: saved.update(more)):
        check_saved(model, lambda saved, learnt=learnt: learnt(saved).predict_detected(data).mean)
        check_saved(model, lambda saved, learnt=learnt: learnt(saved).predict_detection(data.transmitter_position))


def test_the_limit_is_one_of_received_power_whatever_offset_is_removed(fitted):
    """All rows are of a device that is 20 dB weaker than the reference; its limit of detection is what it receives."""
    data, _, model = fitted
    weak = replace(data, groups=pd.Series(["weak"] * len(data), name="phone"))
    removed = Offsets("phone", "usual", {"usual": 0.0, "weak": -20.0}, 1.0).removed(weak)
    found, at = RssiModel().fit(removed), data.transmitter_position
    close = {"atol": 0.1, "rtol": 0}
    torch.testing.assert_close(found.predict(at).mean - 20, model.predict(at).mean, **close)
    torch.testing.assert_close(found.predict_detected(removed).mean - 20, model.predict_detected(data).mean, **close)
    torch.testing.assert_close(found.detection_field.weight, model.detection_field.weight, **close)
    torch.testing.assert_close(found.predict_detection(at, -20.0), model.predict_detection(at), **close)


def hidden_building(located):
    """Return the building of test_floors, in which hardly anything is received two floors away."""
    table, names = building(), list(RECEIVERS)
    return rssi(table.assign(**table[names].where(table[names] > -80)), located)


@pytest.mark.parametrize("located", [True, False])
def test_the_attenuation_of_floors_counts_what_they_hide(located):
    assert estimate_floor_attenuation(hidden_building(located)).db == pytest.approx(FLOOR_DB, abs=3)


def test_another_kernel_keeps_the_limit_of_detection_of_a_building():
    data = hidden_building(located=True)
    model = RssiModel().fit(data)
    found = model.with_chosen_kernel()
    torch.testing.assert_close(found.detection.limit, model.detection.limit, atol=1, rtol=0)
    at = data.transmitter_position
    torch.testing.assert_close(found.predict(at).mean, model.predict(at).mean, atol=3, rtol=0)
    assert ((found.predict_detection(at) > 0.5) == data.detected).double().mean() > 0.85


def test_the_built_in_floor_misses_packets_at_random():
    model = RssiModel().fit(rssi_room(n=200))
    missed = float(model.detection.missed[model.detection.is_limit].mean())
    assert f"{missed:.0%} of all packets are missed at any power" in model.detection.note(model.receiver_names)


@pytest.mark.parametrize(("field_db", "n_limits"), [(20.0, 1), (15.0, 10)])
def test_a_field_whose_head_bends_is_solved_in_few_steps(monkeypatch, field_db, n_limits):
    """The latent field is K s a with the dual coefficients a of its own tangent."""
    generator, n, noise_db = torch.Generator().manual_seed(1), 150, 3.0
    position = torch.rand(n, 3, generator=generator, dtype=torch.float64) * 100
    covariance = field_db**2 * Kernel(60.0, 20.0, matern12_weight=0.6)(position, position)
    heads, latent = Heads.alike(50, 0), torch.linalg.cholesky(covariance + 1e-6 * torch.eye(n))
    latent = latent @ torch.randn(n, generator=generator, dtype=torch.float64)
    power = heads(latent[:, None])[0][:, 0] + noise_db * torch.randn(n, generator=generator, dtype=torch.float64)
    order, weak = power.argsort(descending=True), torch.arange(n) >= n - n_limits
    value, covariance = power[order].clamp_min(power[order][n - n_limits]), covariance[order][:, order]
    steps, cholesky = [], torch.linalg.cholesky
    monkeypatch.setattr(torch.linalg, "cholesky", lambda matrix: steps.append(1) or cholesky(matrix))
    system = value, weak, torch.ones(n, 1).double(), covariance, torch.full((n,), noise_db).double()
    dual, slope, variance, value, _ = solve(*system, heads, 1.345, (2.0, 0.01))
    latent = covariance @ (slope * dual)
    head, slope = (each[:, 0] for each in heads(latent[:, None]))
    total = slope[:, None] * covariance * slope + 1 + variance.diag()
    again = covariance @ (slope * torch.linalg.solve(total, value + slope * latent - head))
    assert len(steps) < 15
    assert float((again - latent).abs().mean()) < 0.4  # [dB]
