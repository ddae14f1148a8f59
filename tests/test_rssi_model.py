"""The RSSI model: its closed form against slow definitions, what it promises of intervals, and what it survives."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from scipy.optimize import minimize
from swiftwrf.rssi.choose import mixing_weights
from swiftwrf.rssi.law import Law, fit_law, harmonics, log_distance
from swiftwrf.rssi.sites import gather
from swiftwrf.rssi.solve import DIRECTIVITY_DB, LAW_DB, Group, solve

from swiftwrf import InputError, Rssi, RssiConfig, fit_rssi, load, rssi_room
from swiftwrf.gp import Kernel
from swiftwrf.rssi import fit as rssi_fit
from swiftwrf.rssi.head import Head, Table, pooled
from swiftwrf.runtime.threads import threads_kept

KERNEL = Kernel(long=4.0, short=1.0, share=0.6, noise=1.0)
FIELD_DB, NOISE_DB = 3.0, 2.0
CPU = torch.device("cpu")


def law_only(n=60, noise=0.0, level=-50.0, exponent=2.0, seed=0):
    """Three receivers that follow the log-distance law exactly, but for noise."""
    generator = torch.Generator().manual_seed(seed)
    receiver = torch.tensor([[0.0, 0, 2], [10, 0, 2], [0, 10, 2]], dtype=torch.float64)
    position = torch.rand(n, 3, generator=generator, dtype=torch.float64) * torch.tensor([10.0, 10.0, 1.0])
    clean = level - 10 * exponent * log_distance(position, receiver)
    rssi = clean + noise * torch.randn(n, 3, generator=generator)
    return Rssi(rssi, position, receiver_position=receiver, receiver_names="abc", name="law")


def with_field(n=150, noise=0.5, seed=0):
    """The law, and a smooth field of some dB on it."""
    data = law_only(n, noise, seed=seed)
    x, y = data.transmitter_position[:, :1], data.transmitter_position[:, 1:2]
    return replace(data, name="field", rssi_dbm=data.rssi_dbm + 6 * torch.sin(x / 2) * torch.cos(y / 2))


def missed(model, test):
    """Median absolute error [dB]."""
    return (model.predict(test.transmitter_position)[0] - test.rssi_dbm).abs().nanmedian()


def group_of(data, fold=None):
    """Its receivers before their fit."""
    n, r = data.rssi_dbm.shape
    distance = log_distance(data.transmitter_position, data.receiver_position)
    return Group(
        receiver=data.receiver_position,
        position=data.transmitter_position,
        local=data.transmitter_position - data.transmitter_position.mean(dim=0),
        rssi=data.rssi_dbm,
        count=torch.ones(n, r, dtype=torch.float64),
        fold=torch.arange(n) % 5 if fold is None else fold,
        law=fit_law(distance, data.rssi_dbm),
        field_db=torch.full((r,), FIELD_DB, dtype=torch.float64),
        noise_db=torch.full((r,), NOISE_DB, dtype=torch.float64),
    )


# --- the closed form -------------------------------------------------------------------------------------------------


def test_solution_is_the_maximum_of_the_posterior():
    """Huber's loss in units of the noise plus the priors, minimised over all 50 numbers by a general optimiser, with the
    head itself instead of its tangent or table."""
    data = with_field(n=40, noise=2.0).columns([1])
    data.rssi_dbm[3] -= 25.0  # outliers, so that the weights matter
    data.rssi_dbm[20] += 15.0
    group = group_of(data)
    config = RssiConfig()
    found = solve(group, KERNEL, config, 50, CPU)

    drawn = Head(1, 50, config.seed).requires_grad_(False).draw().double()
    root = torch.linalg.cholesky(KERNEL(group.local, group.local) + 1e-10 * torch.eye(40, dtype=torch.float64))
    distance = log_distance(group.position, group.receiver)[:, 0]
    bearing = harmonics(group.position, group.receiver)[:, 0]

    def predicted(parameters):
        level, slope = LAW_DB * parameters[0], LAW_DB * parameters[1]
        motion = FIELD_DB * root @ parameters[10:]
        law = group.law.level[0] + level + (group.law.slope[0] + slope) * distance
        head = pooled(drawn, motion[:, None]) - pooled(drawn, torch.zeros(1, 1).double())
        return law + DIRECTIVITY_DB * bearing @ parameters[2:10] + head[:, 0]

    def objective(x):
        parameters = torch.tensor(x, requires_grad=True)
        error = (predicted(parameters) - data.rssi_dbm[:, 0]) / NOISE_DB
        loss = torch.nn.functional.huber_loss(error, torch.zeros_like(error), delta=config.huber, reduction="sum")
        value = loss + 0.5 * parameters.square().sum()
        value.backward()
        return value.item(), parameters.grad.numpy()

    best = minimize(
        objective,
        torch.zeros(50).double().numpy(),
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": 5000, "maxfun": 9000, "ftol": 1e-14},
    )
    motion = KERNEL(group.local, group.local) @ found.coefficient
    mine = found.level + found.slope * distance[:, None] + (bearing @ found.directivity[0])[:, None]
    mine = mine + Table(drawn)(motion)[0] - Table(drawn)(torch.zeros_like(motion))[0]
    torch.testing.assert_close(mine[:, 0], predicted(torch.tensor(best.x)), atol=0.06, rtol=0)


def test_held_out_is_a_fit_without_the_fold():
    """The formula for held-out rows against fits that never see them; without outliers, so that no weight depends on them,
    and without a head, which the formula takes along its tangent."""
    data = with_field(n=60)
    group = group_of(data)
    gentle = RssiConfig(huber=1e6)
    whole = solve(group, KERNEL, gentle, 0, CPU)
    for number in range(5):
        out = group.fold == number
        rest = replace(group, rssi=torch.where(out[:, None], torch.nan, data.rssi_dbm))
        alone = solve(rest, KERNEL, gentle, 0, CPU)
        distance = log_distance(group.position, group.receiver)
        told = alone.level + alone.slope * distance
        told = told + torch.einsum("nrh,rh->nr", harmonics(group.position, group.receiver), alone.directivity)
        torch.testing.assert_close(whole.held_out[out], told[out], atol=1e-5, rtol=0)


def test_table_is_the_head():
    drawn = Head(2, 50, 0).requires_grad_(False).draw()
    motion = torch.linspace(-30, 30, 200)[:, None].expand(-1, 2).contiguous()
    value, slope = Table(drawn)(motion)
    torch.testing.assert_close(value, pooled(drawn, motion), atol=2e-3, rtol=0)
    assert Table(drawn)(torch.zeros(1, 2))[1].sub(1).abs().max() < 0.01  # one dB of motion is one dB of RSSI
    assert (slope.diff(dim=0) > -1e-3).all()  # convex


def test_mixing_weights_find_the_mixture():
    generator = torch.Generator().manual_seed(0)
    predictors = torch.randn(4, 3000, 2, generator=generator, dtype=torch.float64)
    measured = 0.7 * predictors[1] + 0.3 * predictors[3] + 0.1 * torch.randn(3000, 2, generator=generator)
    measured[::50] = torch.nan
    measured[1::50] += 40.0  # outliers that squares would follow
    weight = mixing_weights(predictors, measured)
    torch.testing.assert_close(weight, torch.tensor([0.0, 0.7, 0.0, 0.3]).double(), atol=0.03, rtol=0)
    assert float(weight.sum()) == pytest.approx(1)


# --- the model -------------------------------------------------------------------------------------------------------


def test_fit_learns_the_field_that_the_law_leaves():
    train, test = with_field().split("random")
    model = fit_rssi(train)
    law = fit_law(log_distance(train.transmitter_position, train.receiver_position), train.rssi_dbm)
    left = law(log_distance(test.transmitter_position, test.receiver_position)) - test.rssi_dbm
    assert model.n_primitives == 50
    assert missed(model, test) < 0.3 * left.abs().median()


def test_no_primitives_where_the_law_is_all_there_is():
    model = fit_rssi(law_only(noise=3.0))
    assert model.n_primitives == 0


def test_plain_head_learns_without_a_law():
    train, test = with_field().split("random")
    model = fit_rssi(train, RssiConfig.paper(steps=200))
    assert not model.slope.any()
    mean = (train.rssi_dbm.mean(dim=0) - test.rssi_dbm).abs().median()
    assert missed(model, test) < 0.5 * mean


@pytest.mark.parametrize("split", ["random", "block"])
def test_interval_covers_what_it_says(split):
    """Over five floors with five receivers each."""
    covered = []
    for seed in range(5):
        train, test = rssi_room(n=120, seed=50 + seed).columns([0, 3, 5, 8, 10]).split(split, seed)
        _, low, high = fit_rssi(train, RssiConfig(validation=split)).predict(test.transmitter_position)
        heard = ~test.rssi_dbm.isnan()
        covered.append(((test.rssi_dbm >= low) & (test.rssi_dbm <= high))[heard].double())
    width = 0.04 if split == "random" else 0.06
    assert abs(float(torch.cat(covered).mean()) - 0.8) < width


def test_interval_widens_away_from_measurements():
    model = fit_rssi(with_field())
    _, low, high = model.predict(torch.tensor([[5.0, 5, 0.5], [40.0, 40, 0.5]]))
    assert (high[1] - low[1] > 1.3 * (high[0] - low[0])).all()


def test_far_away_only_the_law_is_left():
    model = fit_rssi(with_field())
    far = torch.tensor([[4000.0, 0, 0]], dtype=torch.float64)
    bearing = torch.einsum("brh,rh->br", harmonics(far, model.receiver).float(), model.directivity)
    law = (model.level + model.slope * log_distance(far, model.receiver)).float() + bearing
    torch.testing.assert_close(model.predict(far)[0], law, atol=1e-3, rtol=0)


def test_shift_of_the_coordinates_changes_nothing():
    """UTM coordinates: all positions moved by 10,000 km."""
    data = with_field()
    shift = torch.tensor([1e7, -1e7, 1e7], dtype=torch.float64)
    moved = replace(
        data,
        receiver_position=data.receiver_position + shift,
        transmitter_position=data.transmitter_position + shift,
    )
    here, there = fit_rssi(data), fit_rssi(moved)
    a, b = here.predict(data.transmitter_position)[0], there.predict(moved.transmitter_position)[0]
    torch.testing.assert_close(a, b, atol=1e-3, rtol=0)


def test_same_data_same_model_and_any_batch():
    data = with_field(n=60)
    a, b = (fit_rssi(data).predict(data.transmitter_position)[0] for _ in range(2))
    assert torch.equal(a, b)
    torch.testing.assert_close(fit_rssi(data).predict(data.transmitter_position, batch=7)[0], a)


def test_any_number_of_threads_gives_the_same_model():
    data, here = with_field(), with_field(seed=1).transmitter_position
    predicted = []
    for threads in (1, 2):
        with threads_kept():
            torch.set_num_threads(threads)
            predicted.append(fit_rssi(data).predict(here))
            assert torch.get_num_threads() == threads
    assert all(map(torch.equal, *predicted))


def test_many_rows_are_gathered_by_place():
    data = law_only(n=4000)
    data.rssi_dbm[::7, 1] = torch.nan
    sites = gather(data)
    assert len(sites.position) <= 1500
    assert len(sites.position) > 1200
    assert int(sites.count.sum()) == int((~data.rssi_dbm.isnan()).sum())
    site = int(sites.of_row[0])
    own = data.subset((sites.of_row == site).nonzero()[:, 0])
    torch.testing.assert_close(sites.position[site], own.transmitter_position.mean(dim=0))
    torch.testing.assert_close(sites.rssi[site], own.rssi_dbm.nanmean(dim=0), equal_nan=True)
    few = gather(data, limit=4000)
    assert torch.equal(few.position, data.transmitter_position)


# --- files -----------------------------------------------------------------------------------------------------------


def test_saved_model_predicts_the_same(tmp_path):
    data = with_field(n=60)
    data = replace(data, receiver_names=("NA", "1", "12:34:56"))
    model = fit_rssi(data)
    model.save(tmp_path / "model.safetensors")
    again = load(tmp_path / "model.safetensors")
    assert again.receiver_names == ("NA", "1", "12:34:56")
    assert again.n_primitives == model.n_primitives
    for a, b in zip(*(m.predict(data.transmitter_position) for m in (again, model)), strict=True):
        assert torch.equal(a, b)


def test_interrupted_fit_goes_on(tmp_path, monkeypatch):
    """Stopped after the first of two groups, it fits only the second, and ends with the same model."""
    monkeypatch.setattr(rssi_fit, "GROUP", 2)
    data = with_field(n=60)
    state, fitted = tmp_path / "state", []

    def interrupt(task, groups):
        yield task(groups[0])
        raise KeyboardInterrupt

    def count(task, groups):
        fitted.extend(groups)
        return map(task, groups)

    with pytest.raises(KeyboardInterrupt):
        fit_rssi(data, parallel=interrupt, checkpoint=state)
    records = []
    resumed = fit_rssi(data, parallel=count, checkpoint=state, on_record=records.append)
    assert len(fitted) == 1
    assert [r["stage"] for r in records] == ["search", "final"]
    whole = fit_rssi(data).predict(data.transmitter_position)[0]
    assert torch.equal(resumed.predict(data.transmitter_position)[0], whole)
    with pytest.raises(InputError, match="another fit"):
        fit_rssi(data, RssiConfig(huber=2.0), checkpoint=state)


@pytest.mark.parametrize("plain", [False, True])
def test_a_fit_with_gaps_goes_on(tmp_path, plain):
    """What was not heard is nan, which files do not hold."""
    data = with_field(n=60)
    data.rssi_dbm[::5, 0] = torch.nan
    config = RssiConfig(plain=plain, steps=5) if plain else None
    drawn = [
        fit_rssi(data, config, checkpoint=tmp_path / "state").predict(data.transmitter_position)[0] for _ in range(2)
    ]
    assert torch.equal(*drawn)


@pytest.mark.parametrize("heard", [12, 0])
def test_a_receiver_that_few_of_many_rows_heard(heard):
    data = with_field(n=700)
    data.rssi_dbm[torch.randperm(700, generator=torch.Generator().manual_seed(0))[heard:], 0] = torch.nan
    assert fit_rssi(data).predict(data.transmitter_position[:5])[0].isfinite().all()


# --- ordinary input that is awkward ----------------------------------------------------------------------------------


@pytest.mark.parametrize("heard", [0, 1, 2, 9, 10])
@pytest.mark.parametrize("validation", ["random", "block"])
def test_a_receiver_heard_rarely_does_not_stop_the_others(heard, validation):
    data = with_field()
    data.rssi_dbm[heard:, 1] = torch.nan
    model = fit_rssi(data, RssiConfig(validation=validation))
    middle, low, high = model.predict(data.transmitter_position)
    assert middle.isfinite().all()
    assert (low < high).all()
    truth = law_only().rssi_dbm.mean()
    assert (middle[:, 1] - truth).abs().max() < 30


def test_a_receiver_heard_in_one_slab_only():
    data = rssi_room(n=200).columns([0, 5])
    slab = data.transmitter_position[:, 0] < 4
    data.rssi_dbm[~slab, 0] = torch.nan
    model = fit_rssi(data, RssiConfig(validation="block"))
    middle, low, high = model.predict(data.transmitter_position)
    assert middle.isfinite().all()
    assert (high - low).max() < 60


@pytest.mark.parametrize(
    "spoil",
    [
        lambda d: d.transmitter_position.fill_(3.0),  # all at one place
        lambda d: d.rssi_dbm.fill_(-70.0),
        lambda d: d.transmitter_position.copy_(d.receiver_position[0]),  # on the receiver
        lambda d: d.rssi_dbm[5].fill_(1e6),
    ],
)
def test_degenerate_data_give_finite_predictions(spoil):
    data = with_field(n=40)
    spoil(data)
    assert torch.stack(fit_rssi(data).predict(with_field(n=10).transmitter_position)).isfinite().all()


def test_refuses():
    data = law_only()
    model = fit_rssi(data)
    with pytest.raises(InputError, match="must be finite numbers"):
        model.predict(torch.tensor([[0.0, 0.0, float("nan")]]))
    with pytest.raises(InputError, match="at most 1e\\+09 m"):
        model.predict(torch.tensor([[1e20, 0.0, 0.0]]))
    assert torch.stack(model.predict(torch.tensor([[1e8, 0.0, 0.0]]))).isfinite().all()
    assert model.predict(torch.empty(0, 3))[0].shape == (0, 3)
    with pytest.raises(InputError, match="heard in 0 training rows"):
        fit_rssi(replace(data, rssi_dbm=data.rssi_dbm * torch.nan))
    with pytest.raises(InputError, match="RSSI must be finite"):
        fit_rssi(replace(data, rssi_dbm=data.rssi_dbm * torch.inf))
    with pytest.raises(InputError, match="same rows"):
        fit_rssi(data, pool=law_only(seed=1))
    for batch in (0, -1):
        with pytest.raises(InputError, match="batch must be at least 1"):
            model.predict(data.transmitter_position, batch=batch)


def test_a_receiver_alone_heard_in_one_slab_only_is_refused():
    """Nothing tells how wrong a model is there; with a pool of others something does."""
    both = rssi_room(n=200).columns([0, 5])
    both.rssi_dbm[both.transmitter_position[:, 0] >= 4, 0] = torch.nan
    alone = both.columns([0])
    with pytest.raises(InputError, match="in one part of the region"):
        fit_rssi(alone, RssiConfig(validation="block"))
    assert fit_rssi(alone, RssiConfig(validation="block"), pool=both).widening.isfinite()


def test_a_fit_does_not_go_on_with_another_pool(tmp_path):
    data = with_field(n=60)
    alone, moved = data.columns([0]), data.receiver_position.clone()
    moved[1] += 5
    fit_rssi(alone, pool=data, checkpoint=tmp_path / "state")
    with pytest.raises(InputError, match="another fit"):
        fit_rssi(alone, pool=replace(data, receiver_position=moved), checkpoint=tmp_path / "state")


def test_law_of_a_receiver_heard_at_one_distance():
    law = fit_law(torch.full((5, 1), 0.5), torch.tensor([[-50.0], [-52], [-54], [-52], [torch.nan]]))
    assert (law.level.item(), law.slope.item()) == (-52.0, 0.0)
    other = Law(torch.tensor([-40.0]), torch.tensor([-20.0]))
    assert law.where(torch.tensor([False]), other) == other
