"""Updates equal a fit to all data with the same kernel; what is forgotten, aged, saved and refused."""

import warnings
from copy import copy
from dataclasses import replace
from functools import cache

import pytest
import quick
import small
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from swiftwrf import AngularGrid, InputError, RssiModel, load, make_model
from swiftwrf.contrib.online import Follower
from swiftwrf.data.coordinates import Floors
from swiftwrf.data.simulated import rssi_room, simulated_room
from swiftwrf.data.writing import write_spectra
from swiftwrf.gp import GaussianProcess, Kernel
from swiftwrf.rssi import FloorAttenuation
from swiftwrf.runtime import checkpoint

SIGNAL = 1e-5  # of the signal: magnitudes up to 1, RSSI over 60 dB
OPTIONS = {"swiftwrf": {"n_primitives": 24}}
PROCESSES = ("gp", "coarray", "swiftwrf", "hybrid")
N, M = 30, 12  # spectra of the fit and of the updates
GRID = AngularGrid.hemisphere(15, 60)


@cache
def data(n=N + M):
    return simulated_room(n=n, grid=GRID)


@cache
def fitted(name):
    with small.known_planes(small.FLOOR):
        return make_model(name, **OPTIONS.get(name, {})).fit(data().subset(torch.arange(N)))


@cache
def floor():
    return rssi_room(n=90)


@cache
def fitted_rssi():
    return RssiModel().fit(floor().subset(torch.arange(60)))


def parts(rows, sizes):
    """Split rows into batches of the sizes, the last one with the remaining rows."""
    start = 0
    for size in sizes:
        yield rows[start : start + size]
        start += size
    yield rows[start:]


orders = st.permutations(range(M)), st.lists(st.integers(1, 5), max_size=5)


@pytest.mark.parametrize("name", PROCESSES)
@settings(max_examples=4, deadline=None)
@given(order=orders[0], sizes=orders[1])
def test_an_update_in_any_order_is_a_regression_on_all_spectra(name, order, sizes):
    model, rows = fitted(name), N + torch.tensor(order)
    updated = model
    for some in parts(rows, sizes):
        updated = updated.update(data().subset(some))
    process = updated.process
    refitted = GaussianProcess(process.kernel, process.known, process.value.double(), exact=True)
    torch.testing.assert_close(process.coefficient, refitted.coefficient.to(process.coefficient), rtol=1e-4, atol=1e-4)
    at = data().position[:5] + 0.03
    once = model.update(data().subset(torch.arange(N, N + M)))
    torch.testing.assert_close(updated.synthesize(at), once.synthesize(at), rtol=0, atol=SIGNAL)
    torch.testing.assert_close(process.variance(process.known), refitted.variance(process.known), rtol=1e-6, atol=1e-9)


def test_an_update_of_pixels_is_a_fit_with_the_same_kernel():
    model = fitted("gp").update(data().subset(torch.arange(N, N + M)))
    mean = data().spectrum[:N].mean(dim=0)
    change = data().spectrum - mean
    kernel, at = model.kernel, data().position[:4] + 0.05
    weight = torch.linalg.solve(kernel.covariance(data().position), kernel(data().position, at))
    expected = mean + torch.einsum("nm,nhw->mhw", weight.float(), change)
    # beside components that do not matter at held-out positions
    torch.testing.assert_close(model.synthesize(at), expected.clamp(0, 1), rtol=0, atol=5e-3)


@pytest.mark.parametrize("name", PROCESSES)
def test_an_update_predicts_what_it_learnt_better_and_leaves_the_model(name):
    model, new = fitted(name), data().subset(torch.arange(N, N + M))
    before = model.synthesize(new.position)
    after = model.update(new).synthesize(new.position)
    assert (after - new.spectrum).square().mean() < 0.5 * (before - new.spectrum).square().mean()
    assert torch.equal(model.synthesize(new.position), before)


@pytest.mark.parametrize("name", PROCESSES)
def test_forgetting_what_was_learnt_restores_the_model(name):
    model, at = fitted(name), data().position[:5] + 0.03
    forgot = model.update(data().subset(torch.arange(N, N + M))).forget(torch.arange(N, N + M))
    torch.testing.assert_close(forgot.synthesize(at), model.synthesize(at), rtol=0, atol=SIGNAL)
    for rows, says in ((torch.tensor([N]), "training rows 0 to 29"), (torch.arange(N), "all of its 30 training rows")):
        with pytest.raises(InputError, match=says):
            model.forget(rows)


@pytest.mark.parametrize("name", PROCESSES)
def test_a_saved_model_is_updated_as_the_one_in_memory(name, tmp_path):
    first, second = (data().subset(rows) for rows in (torch.arange(N, N + 5), torch.arange(N + 5, N + M)))
    model = fitted(name).aged(0.5).update(first)
    model.save(tmp_path / "model.safetensors")
    at = data().position[:5] + 0.03
    expected = model.update(second).synthesize(at)
    found = load(tmp_path / "model.safetensors").update(second).synthesize(at)
    torch.testing.assert_close(found, expected, rtol=0, atol=SIGNAL)


def test_ageing_weighs_earlier_values_less(generator):
    kernel, position = Kernel(noise=1e-2), torch.rand(20, 3, generator=generator, dtype=torch.float64)
    value = torch.randn(20, 2, generator=generator, dtype=torch.float64)
    aged = GaussianProcess(kernel, position, value).aged(0.5)
    new, more = torch.rand(3, 3, generator=generator, dtype=torch.float64), torch.ones(3, 2, dtype=torch.float64)
    found = aged.updated(new, more)
    time = torch.cat([torch.full((20,), 0.5), torch.ones(3)]).double()
    ratio = torch.where(time[:, None] == time, 1.0, 0.5)
    every = torch.cat([position, new])
    covariance = kernel(every, every) * ratio + kernel.noise * torch.eye(23)
    at = torch.rand(4, 3, generator=generator, dtype=torch.float64)
    cross = kernel(at, every) * time
    expected = cross @ torch.linalg.solve(covariance, torch.cat([value, more]))
    torch.testing.assert_close(found.mean(at), expected)


def test_an_update_beyond_the_exact_size_is_local(monkeypatch, generator):
    monkeypatch.setattr("swiftwrf.gp.process.MAX_EXACT", 25)
    position = torch.rand(30, 3, generator=generator, dtype=torch.float64)
    value = torch.randn(30, 2, generator=generator, dtype=torch.float64)
    process = GaussianProcess(Kernel(), position[:24], value[:24]).updated(position[24:], value[24:])
    assert not process.is_exact
    torch.testing.assert_close(process.value, value)


def test_a_room_is_refined_by_its_covariance():
    room = fitted("geometry")
    new = simulated_room(n=20, seed=3, grid=GRID)
    updated = room.update(new)
    assert len(updated.planes) == len(room.planes) > 0
    before, after = (model.estimate.covariance.diagonal() for model in (room, updated))
    assert (after <= before).all()


@settings(max_examples=4, deadline=None)
@given(order=st.permutations(range(30)), sizes=orders[1])
def test_rssi_in_any_order_solves_the_least_squares_of_all_rows(order, sizes):
    model = fitted_rssi()
    updated = model
    for some in parts(60 + torch.tensor(order), sizes):
        updated = updated.update(floor().subset(some))
    once = model.update(floor().subset(torch.arange(60, 90)))
    at = floor().transmitter_position[:10] + 0.5
    tolerance = SIGNAL * 60
    torch.testing.assert_close(updated.predict(at).mean, once.predict(at).mean, rtol=0, atol=tolerance)
    state, before = updated.posterior, model.posterior
    for r in range(12):  # dense covariance of all rows times the dual coefficients is the data
        seen = state.variance[r] > 0
        known, slope, feature = state.position[seen], state.tangent[r, seen], state.feature[r, seen]
        field = slope[:, None] * state.kernel(known, known) * slope
        whole = field + feature @ feature.T + torch.diag(state.variance[r, seen])
        old = before.dual[r, before.variance[r] > 0]
        target = whole[: len(old), : len(old)] @ old
        torch.testing.assert_close((whole @ state.dual[r, seen])[: len(old)], target, rtol=0, atol=1e-2)
    assert set(updated.region().tolist()[0]) == set(once.region().tolist()[0])


def test_rssi_is_updated_after_loading_and_beyond_its_rows_in_memory(tmp_path, monkeypatch):
    model = fitted_rssi().update(floor().subset(torch.arange(60, 70)))
    model.save(tmp_path / "model.safetensors")
    rest, at = floor().subset(torch.arange(70, 90)), floor().transmitter_position[:10] + 0.5
    expected = model.update(rest).predict(at).mean
    loaded = load(tmp_path / "model.safetensors").update(rest)  # the robust weights of the first rows are fixed
    torch.testing.assert_close(loaded.predict(at).mean, expected, atol=0.2, rtol=0)
    monkeypatch.setattr("swiftwrf.rssi.posterior.MAX_NEW_ROWS", 12)
    torch.testing.assert_close(model.update(rest).predict(at).mean, expected, atol=0.2, rtol=0)


@pytest.mark.parametrize("name", PROCESSES)
def test_a_chosen_kernel_is_that_of_a_fit(name):
    """From another kernel, the choice by the values of the process is that by the spectra."""
    model = fitted(name)
    other = model._copy()
    other.process = model.process.with_kernel(Kernel(0.01, matern12_weight=1.0, noise=0.1))
    found = other.with_chosen_kernel()
    assert found.kernel.correlation_length == pytest.approx(model.with_chosen_kernel().kernel.correlation_length)
    torch.testing.assert_close(found.process.value, model.process.value, rtol=1e-4, atol=1e-4)
    if name != "hybrid":  # chooses its kernel before its mixing weight
        assert found.kernel.correlation_length == pytest.approx(model.kernel.correlation_length, rel=0.02)
    assert len(other.with_chosen_kernel(without=torch.arange(10)).process.known) == N - 10


def test_rssi_follows_from_its_residuals():
    model = fitted_rssi().update(floor().subset(torch.arange(60, 90)))
    found = model.posterior.rssi
    missed = (found - floor().rssi_dbm).abs()
    assert torch.equal(found.isnan(), floor().rssi_dbm.isnan())
    assert missed[:60].nanmean() < 0.1
    assert missed[60:].nanmean() < 0.5


def test_rssi_with_a_chosen_kernel_is_a_fit_to_all_rows():
    model = fitted_rssi().update(floor().subset(torch.arange(60, 90))).with_chosen_kernel()
    whole, at = RssiModel().fit(floor()), floor().transmitter_position[:20] + 0.5
    assert model.kernel.matern12_length == pytest.approx(whole.kernel.matern12_length)
    assert model.kernel.noise == whole.kernel.noise
    assert (model.predict(at).mean - whole.predict(at).mean).abs().mean() < 0.5


def test_an_update_removes_the_attenuation_of_floors():
    model, new = fitted_rssi(), floor().subset(torch.arange(60, 90))
    below = copy(model)
    below.attenuation = FloorAttenuation(Floors(("0", "1"), (0.0, 40.0)), (1,) * 12, 20.0)
    at = floor().transmitter_position[:10]
    updated = below.update(replace(new, rssi_dbm=new.rssi_dbm - 20))
    torch.testing.assert_close(updated.predict(at).mean, model.update(new).predict(at).mean - 20, atol=1e-3, rtol=0)


MODELS = {name: (lambda name=name: fitted(name), data, N) for name in (*PROCESSES, "geometry")}
MODELS["rssi"] = (fitted_rssi, floor, 60)


@pytest.mark.parametrize("name", MODELS)
def test_rows_that_a_model_has_learnt_are_not_learnt_twice(name, tmp_path):
    model, rows, n = (part() if callable(part) else part for part in MODELS[name])
    new, last = rows[n:], slice(len(rows) - 2, None)
    assert model.is_learnt(rows).tolist() == [True] * n + [False] * len(new)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        expected = model.update(new)
    expected.save(tmp_path / "model")
    known = f"{rows.name}: {n} of {len(rows)} rows are already in the model and are left out"
    with pytest.warns(UserWarning, match=known):
        found = model.update(rows)
    at = (rows.position if name != "rssi" else rows.transmitter_position)[:5] + 0.03
    assert torch.equal(found.predict(at).mean, expected.predict(at).mean)
    for same in (expected, load(tmp_path / "model")):
        with pytest.warns(UserWarning, match=f"{rows.name}: 2 of 2 rows are already in the model"):
            assert torch.equal(same.update(rows[last]).predict(at).mean, same.predict(at).mean)
        with pytest.raises(InputError, match="row 3, counted from 0, is already in the model; leave it out"):
            Follower(same).step(rows[[3]])


def test_a_measurement_that_repeats_another_is_no_copy_of_it():
    """Equal values at one place are new if they are another row or of another time."""
    known = floor()[:60]
    again = replace(known[:4], index=torch.arange(60, 64))
    assert len(fitted_rssi().update(again).region()) == 64
    timed = replace(known, time=torch.arange(60.0).index_fill(0, torch.tensor([2]), torch.nan))
    model = RssiModel().fit(timed)
    assert model.is_learnt(timed).all()
    for change in (
        {"index": torch.arange(60, 120)},
        {"time": torch.arange(60.0, 120.0)},
        {"rssi_dbm": timed.rssi_dbm + 0.1},
        {"transmitter_position": timed.transmitter_position + 0.01},
    ):
        assert not model.is_learnt(replace(timed, **change)).any()


def test_rows_that_are_forgotten_are_learnt_again():
    model, gone = fitted("gp").update(data()[N:]), torch.tensor([2, N + 1])
    again = model.forget(gone)
    assert again.is_learnt(data()).tolist() == [row not in gone.tolist() for row in range(N + M)]
    assert len(again.update(data()).process.known) == N + M
    rssi = fitted_rssi().update(floor()[60:]).with_chosen_kernel(without=torch.arange(85, 90))
    assert rssi.is_learnt(floor()).tolist() == [True] * 85 + [False] * 5


def test_a_file_without_digests_recognises_what_it_learns_from_now_on(tmp_path):
    fitted("gp").save(tmp_path / "model")
    kind, tensors, header = checkpoint.read(tmp_path / "model", "pixel Gaussian process")
    checkpoint.write(tmp_path / "model", kind, tensors | {"row_digests": tensors["row_digests"][:0]}, header)
    model = load(tmp_path / "model").update(data()[N:])
    assert model.is_learnt(data()).tolist() == [False] * N + [True] * M
    assert model.forget(torch.tensor([0, N])).is_learnt(data()).tolist() == [False] * (N + 1) + [True] * (M - 1)


def test_a_run_without_a_model_of_rssi_is_refused(tmp_path, capsys):
    (tmp_path / "config.json").write_text("{}")
    assert quick.run("update", tmp_path, tmp_path, "--out", tmp_path / "updated") == 2
    assert "is a run without an RSSI model; name one of its models" in capsys.readouterr().err


@pytest.mark.parametrize("file", ["model.safetensors", "."])  # the latter is the directory of a run
def test_spectra_of_a_folder_are_learnt(tmp_path, capsys, file):
    fitted("gp").save(tmp_path / "model.safetensors")
    (tmp_path / "new").mkdir()
    write_spectra(data().subset(torch.arange(N, N + M)), tmp_path / "new")
    assert quick.run("update", tmp_path / file, tmp_path / "new", "--out", tmp_path / "updated") == 0
    *_, learnt, _, _, step, report = capsys.readouterr().out.splitlines()
    assert f"{M} measurements learnt" in learnt
    assert step.startswith("Continue with the updated model: swiftwrf update ")
    assert report.startswith("report: ")
