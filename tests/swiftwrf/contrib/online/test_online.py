"""Scores of measurements before they are learnt, tests for changes, adaptation, and the command that follows."""

import json
import re
from dataclasses import replace
from functools import cache

import pytest
import torch
from rooms import built_in_walls, room_with_box

from swiftwrf import AngularGrid, GeometryModel, RssiModel, make_model
from swiftwrf.contrib.online import Follower, Monitor, adapted, alarm_threshold, prequential, score
from swiftwrf.contrib.online.follower import joined, unexplained
from swiftwrf.data.simulated import ShoeboxRoom, rssi_room, simulated_room
from swiftwrf.metrics import psnr
from swiftwrf.models.geometry import HybridModel
from swiftwrf.models.geometry.planes import Plane

GRID = AngularGrid.hemisphere(15, 60)
PLACE = (1.6, 2.4)


@cache
def spectra(n, seed, place=None):
    return simulated_room(n=n, seed=seed, grid=GRID, room=room_with_box(place) if place else None)


@cache
def coarray():
    return make_model("coarray").fit(spectra(72, 0))


@cache
def floor():
    return rssi_room(n=100)


@cache
def walls():
    """The built-in room with its walls as they are."""
    return GeometryModel.of_planes(spectra(72, 0), built_in_walls())


def test_thresholds_have_the_run_length_of_simulated_series(generator):
    rate, n = 0.005, 400
    threshold = alarm_threshold(rate)
    lengths = []
    for _ in range(150):
        value, length = 0.0, 0
        series = torch.randn(20 * n, generator=generator).tolist()
        while value <= threshold and length < len(series):
            value = max(0.0, value + series[length] - 0.5)
            length += 1
        lengths.append(length)
    mean = sum(lengths) / len(lengths)
    assert 0.7 / rate < mean < 1.4 / rate
    assert alarm_threshold(rate, 10) == pytest.approx(alarm_threshold(rate / 10))


def test_sums_restart_after_an_alarm_and_skip_missing_values():
    test = Monitor(torch.rand(5, 3))  # all positions, and one region
    test.threshold = 2.5
    for z in ([torch.nan, 0.0], [2.0, 0.0], [torch.nan, 0.0], [2.0, 0.0]):
        alarms = test.add(torch.tensor(z))
    assert [(alarm.series, alarm.at, alarm.since) for alarm in alarms] == [(0, 3, 1)]
    assert test.value.tolist() == [0.0, 0.0]


def test_each_measurement_is_predicted_before_it_is_learnt():
    model, new = coarray(), spectra(12, 1)
    scores, learnt = prequential(model, new)
    torch.testing.assert_close(scores.error[0], score(model, new).error[0])
    third = score(model.update(new.subset(torch.arange(2))), new).error[2]
    torch.testing.assert_close(scores.error[2], third)
    assert len(learnt.process.known) == 84


def test_intervals_of_rssi_contain_their_share():
    model = RssiModel().fit(floor().subset(torch.arange(70)))
    scores, _ = prequential(model, floor().subset(torch.arange(70, 100)))
    assert 0.6 < scores.covered.mean() < 0.95


@pytest.mark.parametrize("n_places", [1, 3])
def test_each_region_has_a_place_of_its_own(n_places):
    position = torch.eye(3)[:n_places].repeat(40, 1)
    monitor = Monitor(position)
    assert len(monitor.centre.unique(dim=0)) == len(monitor.centre) == n_places


def test_spectra_that_wait_keep_their_snapshots():
    data = spectra(72, 0).subset(torch.arange(4))
    measured = replace(data, channel=torch.randn(4, 1, 16, dtype=torch.complex64))
    parts = [measured.subset(torch.tensor([i])) for i in range(4)]
    assert torch.equal(joined(parts).channel, measured.channel)
    assert joined([*parts, data]).channel is None


def test_a_change_raises_an_alarm_and_the_same_scene_does_not():
    monitor = Monitor.of(coarray(), spectra(72, 0), 1e-3)
    same, changed = score(coarray(), spectra(60, 1)), score(coarray(), spectra(30, 2, PLACE))
    assert not [a for at, z in zip(same.position, same.innovation, strict=True) for a in monitor.observe(at, z)]
    alarms = [a for at, z in zip(changed.position, changed.innovation, strict=True) for a in monitor.observe(at, z)]
    assert alarms[0].since >= 55
    assert alarms[0].at < 75


def test_a_model_adapts_to_a_change():
    after, test = spectra(40, 2, PLACE), spectra(60, 3, PLACE)
    model, correlation = adapted(coarray(), after)
    found, updated, stale = (
        float(psnr(m.synthesize(test.position), test.spectrum).mean())
        for m in (model, coarray().update(after), coarray())
    )
    assert correlation < 0.7
    assert found > updated + 1 > stale + 1


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_primitives_follow_their_scene_on_each_device(device):
    train, new = spectra(72, 0), spectra(40, 2, PLACE)
    model = make_model("swiftwrf", n_primitives=64).fit(train, device=device)
    follower = Follower(model, train, 1e-3)
    steps = [follower.step(new.subset(torch.tensor([number]))) for number in range(len(new))]
    assert any(step.alarms for step in steps)
    assert min(step.correlation for step in steps if step.correlation is not None) < 0.7
    assert follower.count == 40
    assert follower.model.device.type == device
    assert len(follower.model.with_chosen_kernel().process.known) == 112
    on_cpu = make_model("swiftwrf", n_primitives=64).fit(train)
    expected, found = on_cpu.update(new).predict(new.position), model.update(new).predict(new.position)
    torch.testing.assert_close(found.mean.cpu(), expected.mean, atol=1e-3, rtol=0)
    torch.testing.assert_close(found.std.cpu(), expected.std, atol=1e-3, rtol=1e-3)


def test_a_follower_continues_after_the_model_has_grown():
    """New positions lie outside of those that the tests began with."""
    data = simulated_room(n=80, grid=AngularGrid.hemisphere(8, 32))
    order = data.position[:, 0].argsort()
    train, new = data.subset(order[:50]), data.subset(order[50:65])
    room = GeometryModel.of_planes(train, [Plane((0.0, 0.0, -1.0), offset_m=0.0, gain=-0.6)])
    follower = Follower(HybridModel().fit(train, like=room), train)
    for row in range(len(new)):
        follower.step(new.subset(torch.tensor([row])))
    again = Follower(follower.model)
    again.resume(json.loads(json.dumps(follower.state())))
    assert again.monitor.threshold == follower.monitor.threshold


@cache
def coarse(n, seed):
    return simulated_room(n=n, seed=seed, grid=AngularGrid.hemisphere(10, 40))


def followed(model, new):
    follower = Follower(model)
    return follower, [follower.step(new.subset(torch.tensor([i]))) for i in range(len(new))]


@pytest.mark.parametrize("name", ["gp", "coarray"])
def test_a_kernel_of_few_spectra_is_chosen_again(name):
    # of this room, 15 spectra choose a length that is far too short
    train, new = (coarse(105, 35).subset(rows) for rows in (torch.arange(15), torch.arange(15, 105)))
    model = make_model(name).fit(train)
    follower, steps = followed(model, new)
    notices = [step.notice for step in steps if step.notice]
    assert len(notices) == 1
    assert re.match(r"kernel chosen again after 60 measurements: correlation length 0\.\d+ -> 1\.9 m", notices[0])
    assert follower.model.kernel.correlation_length > 4 * model.kernel.correlation_length
    stale, _ = prequential(model, new)
    error = torch.cat([step.scores.error for step in steps])
    torch.testing.assert_close(error[:60], stale.error[:60])
    assert error[60:].mean() < 0.97 * stale.error[60:].mean()


def test_a_kernel_of_enough_spectra_stays():
    data = coarse(170, 0)
    model = make_model("coarray").fit(data.subset(torch.arange(80)))
    follower, steps = followed(model, data.subset(torch.arange(80, 170)))
    assert not any(step.notice for step in steps)
    assert follower.model.kernel == model.kernel


@cache
def moved(n, seed):
    """The room with a wall that is 0.3 m away from its place."""
    return simulated_room(n=n, seed=seed, grid=GRID, room=ShoeboxRoom(size=(6.3, 5.0, 3.0)))


def test_a_room_whose_wall_moved_is_searched_again():
    follower, new = Follower(walls(), spectra(72, 0)), moved(30, 2)
    follower.resume(json.loads(json.dumps(follower.state())))
    steps = [follower.step(new.subset(torch.tensor([i]))) for i in range(30)]
    (notice,) = [step.notice for step in steps if step.notice]
    assert re.match(r"the room no longer explains the spectra since measurement \d+; fit it again", notice)
    again = Follower(walls())
    again.resume(json.loads(json.dumps(follower.state())))
    assert again.room is None


def test_a_room_that_explains_its_spectra_gives_no_notice():
    follower, new = Follower(walls(), spectra(72, 0)), spectra(100, 1)
    missing = unexplained(walls(), new)
    assert not [a for at, x in zip(new.position, missing, strict=True) for a in follower.room.observe(at, x[None])]


def test_spectra_that_a_room_has_learnt_do_not_calibrate_its_alarms():
    """Their errors are lower than those of new spectra."""
    assert len(Monitor.of(walls(), spectra(72, 0)).reference) == 0


def test_a_followed_geometry_is_refined_with_every_ten_spectra():
    follower, new = Follower(walls()), spectra(12, 1)
    models = []
    for i in range(12):
        follower.step(new.subset(torch.tensor([i])))
        models.append(follower.model)
    assert models[8] is walls()
    assert models[9] is not walls()
    assert models[11] is models[9]
    offset = walls().tensors().offset  # of planes without uncertainty
    torch.testing.assert_close(models[9].tensors().offset, offset)


def test_an_alarm_names_the_receiver_the_direction_and_the_region():
    place = torch.tensor([[0.0, 0.0, 1.0], [5.0, 3.0, 1.0]])
    for at, where in zip(place, ("around 0.0, 0.0, 1.0 m", "around 5.0, 3.0, 1.0 m"), strict=True):
        monitor = Monitor(place.repeat(20, 1), ["hall", "office"], n_regions=2)
        alarms = [alarm for _ in range(9) for alarm in monitor.observe(at, torch.tensor([torch.nan, -3.0]))]
        assert {monitor.describe(alarm) for alarm in alarms} == {f"office weaker {where}", "office weaker everywhere"}
