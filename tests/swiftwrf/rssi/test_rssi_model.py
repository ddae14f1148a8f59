"""The RSSI model: its regression against slow definitions, its intervals, its files, and awkward data."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.optimize import minimize
from small import only

from swiftwrf import InputError, PairModel, Rssi, RssiLocator, RssiModel, fit_rssi, rssi_room
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.contrib.comparison.steps import Memo
from swiftwrf.data.coordinates import GeodeticOrigin
from swiftwrf.data.splits import folds
from swiftwrf.gp import Kernel
from swiftwrf.rssi import RssiConfig, RssiPaperModel, compare
from swiftwrf.rssi.detection import Detection
from swiftwrf.rssi.head import Head, Heads, mean_magnitude, render
from swiftwrf.rssi.path_loss import PathLoss, PathLosses, fit_path_loss, fit_path_losses, log_distance
from swiftwrf.rssi.posterior import RssiPosterior, regressors
from swiftwrf.rssi.regression import fit_receiver
from swiftwrf.rssi.training import Bins, RssiTraining, choose_residual_kernels, rough_candidates
from swiftwrf.runtime.digest import computed_once

KERNEL = Kernel(4.0, 1.0, matern12_weight=0.6, noise=1.0)
FIELD_DB, NOISE_DB, PATH_LOSS_STD_DB = 3.0, 2.0, 30.0
CPU, FIRST = torch.device("cpu"), 0


@only(RSSI_PREDICTORS, "swiftwrf", "mean", "knn")
def test_steps_and_receivers_of_workers_are_those_computed_here():
    """Receivers of the model go through `parallel` alone, those of other predictors do not."""
    data, asked = rssi_room(n=80).columns([1, 5]), []

    def parallel(function, items):
        asked.append(list(items))
        return map(function, asked[-1])

    here = compare(data, fewer=(0.5,))
    with ThreadPoolExecutor(1) as executor:
        found = [compare(data, fewer=(0.5,), executor=executor)]
        found.append(compare(data, fewer=(0.5,), executor=executor, parallel=parallel))
    for there in found:
        pd.testing.assert_frame_equal(there.summary()[["median", "mean"]], here.summary()[["median", "mean"]])
        pd.testing.assert_frame_equal(there.by_rows, here.by_rows)
        assert there.region == here.region
    assert asked == 6 * [[0, 1]]  # all rows, half of them, and those outside of the region, each by two kernels


@only(RSSI_PREDICTORS, "swiftwrf", "mean", "knn")
def test_errors_by_the_number_of_training_rows(tmp_path):
    room = rssi_room(n=200, seed=1)
    asked = []
    whole, found = compare(room, receivers=["6"]), compare(room, receivers=["6"], fewer=(0.01, 0.25, 0.5)).by_rows
    with mock.patch.object(Memo, "begin", lambda _, name, title: asked.append(name)):
        compare(room, receivers=["6"], fewer=(0.01,), keep=Memo(tmp_path))
    assert list(found.columns) == ["swiftwrf", "knn"]
    assert list(found.index) == [40, 80, 160]  # 2 rows determine nothing
    errors = whole.summary()["mean"]
    assert found.loc[160].to_dict() == pytest.approx(errors[["swiftwrf", "knn"]].to_dict())
    assert whole.by_rows.empty
    assert asked == ["swiftwrf", "fewer rows", "mean", "knn"]  # as many steps as a run announces


@only(RSSI_PREDICTORS, "swiftwrf", "mean", "knn")
def test_error_in_a_region_is_that_of_a_fit_to_all_rows_elsewhere():
    """The region is the second fifth of the training rows along the longer side of the floor."""
    room = rssi_room(n=200, seed=1).columns([2, 5])
    result = compare(room, fewer=(0.5,), seed=1)
    train = room.split("random", 1)[0]
    along = train.transmitter_position[:, :2].numpy()
    along = (along - along.mean(axis=0)) @ np.linalg.eigh(np.cov(along.T))[1][:, -1]
    for inside in (np.argsort(np.argsort(side)) * 5 // len(along) == 1 for side in (along, -along)):
        model = RssiModel(validation="block", seed=1).fit(train.subset(torch.tensor(np.flatnonzero(~inside))))
        part = train.subset(torch.tensor(np.flatnonzero(inside)))
        error = (model.predict_detected(part).mean - part.rssi_dbm)[part.detected].abs().mean()
        if float(error) == pytest.approx(result.region["swiftwrf"], rel=1e-3):
            break
    else:
        pytest.fail(f"{result.region} is of no second fifth")
    assert {*result.region} == {"swiftwrf", "knn"}
    assert compare(room, split="block", fewer=(0.5,)).region == {}


def path_loss_only(n=60, noise=0.0, level=-50.0, exponent=2.0, seed=0):
    """Three receivers that follow the path-loss model exactly, except for noise."""
    generator = torch.Generator().manual_seed(seed)
    receiver = torch.tensor([[0.0, 0, 2], [10, 0, 2], [0, 10, 2]], dtype=torch.float64)
    position = torch.rand(n, 3, generator=generator, dtype=torch.float64) * torch.tensor([10.0, 10.0, 1.0])
    clean = level - 10 * exponent * log_distance(position, receiver)
    rssi = clean + noise * torch.randn(n, 3, generator=generator)
    return Rssi(rssi, position, receiver_position=receiver, receiver_names=list("abc"), name="path loss")


def with_field(n=150, noise=0.5, seed=0):
    """The path-loss model, and a smooth field of some dB."""
    data = path_loss_only(n, noise, seed=seed)
    x, y = data.transmitter_position[:, :1], data.transmitter_position[:, 1:2]
    return replace(data, name="field", rssi_dbm=data.rssi_dbm + 6 * torch.sin(x / 2) * torch.cos(y / 2))


def both(prediction):
    """Mean and standard deviation in one tensor."""
    return torch.stack([prediction.mean, prediction.std])


def training_of(data, n_primitives=50):
    """The training data of the receivers, each row a bin."""
    n, r = data.rssi_dbm.shape
    centre = data.transmitter_position.mean(dim=0)
    distance = log_distance(data.transmitter_position, data.receiver_position)
    path_loss = fit_path_loss(distance, data.rssi_dbm)
    return RssiTraining(
        receiver_names=data.receiver_names,
        receiver=data.receiver_position - centre,
        centre=centre,
        position=data.transmitter_position - centre,
        bin_of_row=torch.arange(n),
        folds=(torch.arange(n) % 5,),
        rssi=data.rssi_dbm,
        count=torch.ones(n, r, dtype=torch.float64),
        kernel=KERNEL,
        heads=Heads.alike(n_primitives, seed=0),
        path_loss=PathLosses(
            each=path_loss,
            shared=path_loss,
            root=PATH_LOSS_STD_DB * torch.eye(2).double().repeat(r, 1, 1),
            variance=torch.full((r,), FIELD_DB**2 + NOISE_DB**2).double(),
            detection=None,
            floor_db=torch.zeros(r).double(),
        ),
        shift=torch.zeros(n, r).double(),
        limit=torch.full((n, r), torch.nan).double(),
        field_db=torch.full((r,), FIELD_DB, dtype=torch.float64),
        noise_db=torch.full((r,), NOISE_DB, dtype=torch.float64),
    )


def posterior(training, found):
    """The posterior of one receiver's fit."""
    tensors = {name: value[None] for name, value in found.items() if name not in ("covariance", "held_out")}
    shared = {
        name: getattr(training, name) for name in ("kernel", "heads", "receiver", "position", "field_db", "noise_db")
    }
    return RssiPosterior(huber=1.345, measured=(~training.rssi.isnan()).T.double(), **shared, **tensors)


# --- the regression -------------------------------------------------------------------------------------------------


def test_solution_is_the_maximum_of_the_posterior():
    """Huber's loss in units of the noise plus the priors, minimised over all 50 numbers by a general optimiser, with the
    head itself instead of its tangent or table."""
    data = with_field(n=40, noise=2.0).columns([1])
    data.rssi_dbm[3] -= 25.0  # outliers, so that the weights matter
    data.rssi_dbm[20] += 15.0
    training, config = training_of(data), RssiConfig()
    found = posterior(training, fit_receiver(FIRST, training, config, CPU))

    rendered = training.heads.rendered.double()
    gram = KERNEL(training.position, training.position)
    root = torch.linalg.cholesky(gram + 1e-10 * torch.eye(40, dtype=torch.float64))
    distance = log_distance(training.position, training.receiver)[:, 0]
    linear = regressors(training.position, training.receiver, training.path_loss.root)[0]

    def predicted(parameters):
        latent = FIELD_DB * root @ parameters[10:]
        path_loss = training.path_loss.shared.level[0] + training.path_loss.shared.slope[0] * distance
        head = mean_magnitude(rendered, latent[:, None]) - mean_magnitude(rendered, torch.zeros(1, 1).double())
        return path_loss + linear @ parameters[:10] + head[:, 0]

    def objective(x):
        parameters = torch.tensor(x, requires_grad=True)
        error = (predicted(parameters) - data.rssi_dbm[:, 0]) / NOISE_DB
        loss = torch.nn.functional.huber_loss(error, torch.zeros_like(error), delta=config.huber, reduction="sum")
        value = loss + 0.5 * parameters.square().sum()
        value.backward()
        return value.item(), parameters.grad.numpy()

    options = {"maxiter": 5000, "maxfun": 9000, "ftol": 1e-14}
    best = minimize(objective, np.zeros(50), jac=True, method="L-BFGS-B", options=options)
    torch.testing.assert_close(
        found.at(training.position, gram)[0][:, 0], predicted(torch.tensor(best.x)), atol=0.06, rtol=0
    )


def test_held_out_is_a_fit_without_the_fold():
    """The formula for held-out rows against fits that never see them; without outliers, so that no weight depends on them,
    and without a head, which the formula takes along its tangent. Every sixth row is empty."""
    training, gentle = training_of(with_field(n=60).columns([1]), n_primitives=0), RssiConfig(huber=1e6)
    training = replace(training, rssi=training.rssi.where(torch.arange(60)[:, None] % 6 > 0, torch.nan))
    (whole,) = fit_receiver(FIRST, training, gentle, CPU)["held_out"]
    for number in range(5):
        out = training.fold == number
        rest = replace(training, rssi=torch.where(out[:, None], torch.nan, training.rssi))
        alone = posterior(training, fit_receiver(FIRST, rest, gentle, CPU))
        expected = alone.at(training.position, KERNEL(training.position, training.position))[0][:, 0]
        torch.testing.assert_close(whole[out], expected[out], atol=1e-5, rtol=0)


def test_table_is_the_head():
    rendered = render([Head(50, seed).requires_grad_(False) for seed in (0, 1)])
    latent = torch.linspace(-30, 30, 200)[:, None].expand(-1, 2).contiguous()
    value, slope = Heads(rendered)(latent)
    change = mean_magnitude(rendered, latent) - mean_magnitude(rendered, torch.zeros(1, 2))
    torch.testing.assert_close(value, change, atol=2e-3, rtol=0)
    assert Heads(rendered)(torch.zeros(1, 2))[1].sub(1).abs().max() < 0.01  # 1 dB of the field is 1 dB of RSSI
    assert (slope.diff(dim=0) > -1e-3).all()  # convex


# --- the model -------------------------------------------------------------------------------------------------------


def test_errors_at_held_out_rows_are_those_of_the_model_and_of_the_receivers_means():
    """RSSI that no place explains: the mean of a receiver is better than its path loss. On a floor the model is."""
    generator = np.random.default_rng(2)
    position = np.column_stack([generator.uniform(0, 10, (40, 2)), np.ones(40)])
    noise = Rssi(
        (-60 + generator.normal(0, 3, (40, 2))).round(), position, receiver_position=[[0.0, 0, 1], [10.0, 10, 1]]
    )
    fold = folds(noise.transmitter_position, "random", 0).numpy()
    rssi = noise.rssi_dbm.numpy()
    mean = np.stack([rssi[fold != own].mean(axis=0) for own in fold])
    found = RssiModel().fit(noise).held_out_db
    assert found["mean"] == pytest.approx(np.abs(mean - rssi).mean(), abs=1e-6)
    assert found["swiftwrf"] > found["mean"]
    found = RssiModel().fit(with_field()).held_out_db
    assert found["swiftwrf"] < 0.7 * found["mean"]


@pytest.mark.parametrize("max_locations", [1500, 100])
def test_a_survey_of_averages_has_less_noise_than_packets(max_locations):
    """With packets alone in mind the map is smoother than the field: errors of 0.8 dB for 0.4."""
    generator = torch.Generator().manual_seed(0)
    position = torch.rand(200, 3, generator=generator).double() * torch.tensor([30.0, 20, 0])
    truth = -60 + 6 * torch.sin(position[:, :1] / 3 + torch.arange(3))
    rssi = truth + 0.3 * torch.randn(200, 3, generator=generator)
    data = Rssi(rssi, position, receiver_names=list("abc"))
    train, test = data.subset(torch.arange(120)), position[120:]
    model, packets = (
        RssiModel(max_locations=max_locations, **each).fit(train) for each in ({}, {"noises": (0.3, 1.0)})
    )
    error, other = (float((each.predict(test).mean - truth[120:]).abs().mean()) for each in (model, packets))
    assert model.kernel.noise < 0.3
    assert error < 0.7 * other


def test_primitives_are_for_a_field():
    assert fit_rssi(with_field()).n_primitives == 50
    assert fit_rssi(path_loss_only(noise=3.0)).n_primitives == 0


def test_paper_head_learns_without_a_path_loss_model():
    train, test = with_field().columns([0]).split("random")
    model = RssiPaperModel(steps=200).fit(train)
    assert not model.path_loss.slope.any()
    found, mean = (
        (predicted - test.rssi_dbm).abs().median()
        for predicted in (model.predict(test.transmitter_position).mean, train.rssi_dbm.mean(dim=0))
    )
    assert found < 0.5 * mean


@pytest.mark.parametrize("split", ["random", "block"])
def test_interval_has_its_nominal_coverage(split):
    """Over five floors with five receivers each."""
    covered = []
    for seed in range(5):
        train, test = rssi_room(n=120, seed=50 + seed).columns([0, 3, 5, 8, 10]).split(split, seed)
        model = RssiModel(validation=split).fit(train)
        low, high = model.predict(test.transmitter_position).interval(0.8)
        heard = ~test.rssi_dbm.isnan()
        covered.append(((test.rssi_dbm >= low) & (test.rssi_dbm <= high))[heard].double())
    width = 0.04 if split == "random" else 0.06
    assert abs(float(torch.cat(covered).mean()) - 0.8) < width


def test_far_away_the_prediction_is_the_path_loss_model():
    """Directivity is equal in one direction, and nearly 0 on average over all."""
    model = fit_rssi(with_field())
    direction = torch.nn.functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)).double())
    near, far = (model.predict(metres * direction).mean for metres in (4e5, 8e5))
    decades = model.path_loss.slope.float() * math.log10(2)
    torch.testing.assert_close(far - near, decades.expand_as(far), atol=2e-3, rtol=0)
    path_loss = model.path_loss.level + model.path_loss.slope * math.log10(4e5)
    torch.testing.assert_close(near.mean(dim=0), path_loss.float(), atol=0.1, rtol=0)


@pytest.mark.parametrize("make", [RssiModel, PairModel])
def test_rows_about_another_origin_are_predicted_where_they_were_measured(make):
    data = replace(path_loss_only(), origin=GeodeticOrigin(48.0, 11.0))
    model, other = make().fit(data), data.about(GeodeticOrigin(48.001, 11.001))
    found, expected = (both(model.predict_detected(some)) for some in (other, data))
    torch.testing.assert_close(found, expected, atol=1e-2, rtol=0)


def test_same_data_same_model_and_any_batch(monkeypatch):
    data = with_field(n=60)
    a, b = (fit_rssi(data).predict(data.transmitter_position).mean for _ in range(2))
    assert torch.equal(a, b)
    monkeypatch.setattr(RssiModel, "batch_size", 7)
    torch.testing.assert_close(fit_rssi(data).predict(data.transmitter_position).mean, a)


def test_many_rows_are_averaged_by_location():
    data = path_loss_only(n=4000)
    data.rssi_dbm[::7, 1] = torch.nan
    bins, alone = (Bins.of(data, RssiConfig(max_locations=n)) for n in (1500, 4000))
    assert 1200 < len(bins.position) <= 1500
    assert int(bins.count.sum()) == int((~data.rssi_dbm.isnan()).sum())
    first = int(bins.bin_of_row[0])
    rows = data.subset((bins.bin_of_row == first).nonzero()[:, 0])
    torch.testing.assert_close(bins.position[first] + bins.centre, rows.transmitter_position.mean(dim=0))
    torch.testing.assert_close(bins.rssi[first], rows.rssi_dbm.nanmean(dim=0), equal_nan=True)
    torch.testing.assert_close(alone.position + alone.centre, data.transmitter_position)


@pytest.mark.parametrize("make", [RssiModel, partial(RssiPaperModel, steps=5)], ids=["quick", "paper"])
def test_a_receiver_does_not_depend_on_the_others(make):
    """Neither on their number nor on its place among them, with the same pool."""
    pool = rssi_room(n=200)
    position = rssi_room(n=20, seed=1).transmitter_position
    alone = make().fit(pool.receivers(["6"]), pool=pool).predict(position)
    for names in (["5", "6"], ["1", "2", "3", "4", "6"]):
        among = make().fit(pool.receivers(names), pool=pool).predict(position)
        torch.testing.assert_close(both(among)[:, :, -1:], both(alone), atol=1e-3, rtol=0)


def test_names_of_receivers_change_nothing_in_training_and_locating():
    room = rssi_room(n=60).receivers(["1", "2", "3"])
    renamed = replace(room, receiver_names=("c", "a", "b"))
    learnt = [RssiPaperModel(steps=3).fit(data).predict(room.transmitter_position).mean for data in (room, renamed)]
    torch.testing.assert_close(learnt[1], learnt[0])
    located = [RssiLocator(n_cells=100).fit(data).locate(room.rssi_dbm[:5]).median for data in (room, renamed)]
    torch.testing.assert_close(located[1], located[0])


# --- awkward data ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "n_detected"), [(150, 0), (150, 2), (150, 10), (700, 0), (700, 12)])
@pytest.mark.parametrize("validation", ["random", "block"])
def test_a_rarely_detected_receiver_does_not_stop_the_others(n, n_detected, validation):
    data = with_field(n)
    data.rssi_dbm[torch.randperm(n, generator=torch.Generator().manual_seed(0))[n_detected:], 1] = torch.nan
    model = fit_rssi(data, RssiConfig(validation=validation))
    prediction = model.predict(data.transmitter_position)
    assert prediction.mean.isfinite().all()
    assert (prediction.std > 0).all()
    truth = path_loss_only().rssi_dbm.mean()
    assert (prediction.mean[:, 1] - truth).abs().max() < 30


def with_rare(data, n_rare=60):
    """More receivers, as a phone lists them in passing: each is detected in at most three rows."""
    generator = torch.Generator().manual_seed(0)
    rare = torch.full((len(data), n_rare), torch.nan)
    row = torch.randint(len(data), (3, n_rare), generator=generator)
    rare[row, torch.arange(n_rare)] = -85 + 6 * torch.randn(3, n_rare, generator=generator)
    names = tuple(f"passing {number}" for number in range(n_rare))
    return replace(
        data,
        rssi_dbm=torch.cat([data.rssi_dbm, rare], dim=1),
        receiver_position=torch.cat([data.receiver_position, torch.full((n_rare, 3), torch.nan)]),
        receiver_names=data.receiver_names + names,
    )


@only(RSSI_PREDICTORS, "swiftwrf")
def test_receivers_that_were_detected_a_few_times_choose_nothing():
    data = replace(with_field(), receiver_position=torch.full((3, 3), torch.nan))
    expected, found = compare(data), compare(with_rare(data))
    assert found.errors.predicted_dbm.tolist() == expected.errors.predicted_dbm.tolist()
    alone, among = fit_rssi(data), fit_rssi(with_rare(data))
    assert among.kernel == alone.kernel


def test_another_kernel_keeps_the_intervals_of_rows_in_bins():
    generator = torch.Generator().manual_seed(0)
    position = torch.rand(1500, 3, generator=generator).double() * torch.tensor([30.0, 20.0, 0.0])
    receiver = torch.tensor([[0.0, 0.0, 2.0], [30.0, 20.0, 2.0]]).double()
    rssi = -40 - 25 * torch.cdist(position, receiver).log10() + 4 * torch.sin(position[:, :1] / 2)
    rssi = rssi + 5 * torch.randn(1500, 2, generator=generator)
    data = Rssi(rssi, position, receiver_position=receiver)
    train, test = data.subset(torch.arange(1000)), data.subset(torch.arange(1000, 1500))
    model = RssiModel(max_locations=150).fit(train)
    for some in (model, model.with_chosen_kernel()):
        low, high = some.predict(test.transmitter_position).interval(0.8)
        assert 0.75 < ((low <= test.rssi_dbm) & (test.rssi_dbm <= high)).double().mean() < 0.85


def test_a_receiver_that_is_nowhere_and_detects_nothing_has_the_mean_level():
    data = rssi_room(n=60)
    position, rssi = data.receiver_position.clone(), data.rssi_dbm.clone()
    position[0], rssi[:, 0] = torch.nan, torch.nan
    train = replace(data, receiver_position=position, rssi_dbm=rssi)
    found = fit_rssi(train).predict(train.transmitter_position).mean[:, 0]
    assert found.std() < 0.1
    assert float(found.mean()) == pytest.approx(float(rssi.nanmean()), abs=1)


def test_a_lone_receiver_detected_in_one_slab_only_is_refused():
    """Its error cannot be estimated without a pool of other receivers."""
    pool = rssi_room(n=200).columns([0, 5])
    pool.rssi_dbm[pool.transmitter_position[:, 0] >= 4, 0] = torch.nan
    alone = pool.columns([0])
    with pytest.raises(InputError, match="in one part of the region"):
        fit_rssi(alone, RssiConfig(validation="block"))
    assert fit_rssi(alone, RssiConfig(validation="block"), pool=pool).noise_db.isfinite()


def test_path_loss_model_of_a_receiver_detected_at_one_distance():
    found = fit_path_loss(torch.full((5, 1), 0.5), torch.tensor([[-50.0], [-52], [-54], [-52], [torch.nan]]))
    assert (found.level.item(), found.slope.item()) == (-52.0, 0.0)
    other = PathLoss(torch.tensor([-40.0]), torch.tensor([-20.0]))
    assert found.where(torch.tensor([False]), other) == other


@pytest.mark.parametrize("missing", [0.0, 0.1, 0.7], ids=["complete", "few empty", "most empty"])
def test_the_kernel_has_the_lowest_error_of_processes_without_each_fold(generator, missing):
    n, noises = 60, (0.1, 1.0)
    position = 20 * torch.rand(n, 3, generator=generator, dtype=torch.float64)
    scale = 1 + torch.rand(n, generator=generator, dtype=torch.float64)
    compared = rough_candidates(position, noises)
    true = compared[2](position, position) + 0.1 * scale.diag()
    residual = (torch.linalg.cholesky(true) @ torch.randn(n, 8, generator=generator).double()).reshape(n, 4, 2)
    residual[torch.rand(n, 4, generator=generator) < missing] = torch.nan
    fold = torch.arange(n) % 5
    score = []
    for kernel in compared:
        covariance = (kernel(position, position) + kernel.noise * scale.diag()).numpy()
        errors = []
        for column in residual.unbind(dim=1):
            detected = ~column[:, 0].isnan()
            for number in range(5):
                out, kept = ((each & detected).numpy() for each in (fold == number, fold != number))
                weight = np.linalg.solve(covariance[kept][:, kept], covariance[kept][:, out]).T
                errors.append(column.numpy()[out] - weight @ column.numpy()[kept])
        score.append(np.abs(np.concatenate(errors)).mean(axis=0))
    bins = SimpleNamespace(position=position, fold=fold, noise_scale=scale)
    chosen = choose_residual_kernels(bins, residual, noises, least_noise=(0.0, 0.5))
    allowed = [kernel.noise >= 0.5 for kernel in compared]
    lowest = [np.array(score)[:, 0].argmin(), np.where(allowed, np.array(score)[:, 1], np.inf).argmin()]
    assert [kernel for kernel, _ in chosen] == [compared[number] for number in lowest]
    without = residual.abs().flatten(0, 1).nanmean(dim=0).tolist()
    assert [has_field for _, has_field in chosen] == [score[n][k] < without[k] for k, n in enumerate(lowest)]


@pytest.mark.parametrize("varied", ["nothing", "shift", "floors"])
def test_rows_at_one_position_count_as_each_alone(generator, varied):
    room = rssi_room(n=30)
    position = room.transmitter_position.repeat(4, 1)
    rssi = room.rssi_dbm.repeat(4, 1) + 3 * torch.randn(120, 12, generator=generator, dtype=torch.float64)
    rssi[rssi < -70] = torch.nan
    shift, crossed = torch.zeros_like(rssi), torch.zeros_like(rssi)
    different = torch.arange(120)[:, None] % 7 * torch.ones(12).double()
    shift, crossed = shift + different * (varied == "shift"), crossed + different * (varied == "floors")
    curve = Detection(
        rssi[~rssi.isnan()].min().repeat(12), 1.0, torch.full((12,), 0.02).double(), torch.ones(12).bool()
    )
    rows = room.receiver_position, rssi, "weak", shift, curve, crossed
    together = fit_path_losses(position, *rows)
    nearby = position + 1e-9 * torch.arange(120)[:, None]  # every row at a position of its own
    alone = fit_path_losses(nearby, *rows)
    for own, other in ((together.each, alone.each), (together.shared, alone.shared)):
        torch.testing.assert_close(own, other, atol=1e-5, rtol=1e-6)
    torch.testing.assert_close(together.variance, alone.variance, atol=1e-5, rtol=1e-6)


def test_predictors_of_the_same_rows_estimate_the_curve_of_detection_once():
    data = rssi_room(n=60)
    with_empty = data.derived(rssi_dbm=data.rssi_dbm.where(data.rssi_dbm > -65, torch.nan))
    asked = []

    def curve(position, rssi):
        asked.append(rssi)
        return Detection.estimate(position, rssi)

    with mock.patch("swiftwrf.rssi.base._detection_curve", computed_once(curve)):
        first, second = (RSSI_PREDICTORS[name]().fit(with_empty) for name in ("mean", "mri_receiver"))
        assert len(asked) == 1
        assert torch.equal(first.detection.limit, second.detection.limit)
        changed = with_empty.rssi_dbm.clone()
        changed[0, ~changed[0].isnan()] -= 1
        other = RSSI_PREDICTORS["mean"]().fit(with_empty.derived(rssi_dbm=changed))
    assert len(asked) == 2
    expected = Detection.estimate(data.transmitter_position, changed)
    assert torch.equal(other.detection.limit, expected.limit)
