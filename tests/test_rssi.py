"""The RSSI model, its baselines and its task."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

from swiftwrf import FitError, InputError, Rssi, RssiConfig, fit_rssi, rssi_room
from swiftwrf.rssi import fit as rssi_fit
from swiftwrf.rssi import log_distance
from swiftwrf.rssi import model as rssi_model
from tasks.rssi import experiment
from tasks.rssi.cluster import on_cluster
from tasks.rssi.predictors import PREDICTORS, Settings
from tasks.run import command_line

QUICK = RssiConfig(steps=60)


def law_only(n=60, noise=0.0, level=-50.0, exponent=2.0, seed=0):
    """Three receivers that follow the log-distance law exactly, but for noise."""
    generator = torch.Generator().manual_seed(seed)
    receiver = torch.tensor([[0.0, 0, 2], [10, 0, 2], [0, 10, 2]], dtype=torch.float64)
    position = torch.rand(n, 3, generator=generator, dtype=torch.float64) * torch.tensor([10.0, 10.0, 1.0])
    clean = level - 10 * exponent * torch.cdist(position, receiver).log10()
    rssi = clean + noise * torch.randn(n, 3, generator=generator)
    return Rssi("law", ("a", "b", "c"), receiver, position, rssi, torch.arange(n))


def with_field(n=150, noise=0.5, seed=0):
    """The law, and a smooth field of some dB on it."""
    data = law_only(n, noise, seed=seed)
    field = 6 * torch.sin(data.transmitter_position[:, :1] / 2) * torch.cos(data.transmitter_position[:, 1:2] / 2)
    return Rssi(
        "field",
        data.receiver_names,
        data.receiver_position,
        data.transmitter_position,
        data.rssi_dbm + field,
        data.index,
    )


def test_fit_learns_the_field_that_the_law_leaves():
    train, test = with_field().split("random")
    model = fit_rssi(train, QUICK)
    law = PREDICTORS["mri_receiver"].make(Settings())
    law.fit(train)
    errors = [
        (p - test.rssi_dbm).abs().median()
        for p in (model.predict(test.transmitter_position)[0], law.predict(test.transmitter_position))
    ]
    assert model.n_primitives == 50
    assert errors[0] < 0.6 * errors[1]


def test_no_primitives_where_the_law_is_all_there_is():
    model = fit_rssi(law_only(noise=3.0), QUICK)
    assert model.n_primitives == 0


def test_plain_head_learns_without_a_law():
    train, test = with_field().split("random")
    model = fit_rssi(train, RssiConfig.paper(steps=200))
    assert not model.groups[0].slope.any()
    missed = (model.predict(test.transmitter_position)[0] - test.rssi_dbm).abs().median()
    mean = (train.rssi_dbm.mean(dim=0) - test.rssi_dbm).abs().median()
    assert missed < 0.8 * mean


def test_interval_covers_about_what_it_says():
    train, test = with_field(n=300, noise=2.0).split("random")
    _, low, high = fit_rssi(train, QUICK).predict(test.transmitter_position)
    covered = ((test.rssi_dbm >= low) & (test.rssi_dbm <= high)).double().mean()
    assert 0.65 < covered < 0.93


def test_interval_widens_away_from_measurements():
    model = fit_rssi(with_field(), QUICK)
    _, low, high = model.predict(torch.tensor([[5.0, 5, 0.5], [40.0, 40, 0.5]]))
    assert (high[1] - low[1] > high[0] - low[0]).all()


def test_far_away_only_the_law_is_left():
    model = fit_rssi(with_field(), QUICK)
    far = torch.tensor([[4000.0, 0, 0]], dtype=torch.float64)
    group = model.groups[0]
    bearing = 2.0 * torch.einsum("brh,rh->br", group.harmonics(far), group.directivity)
    law = group.level + group.slope * log_distance(far, group.receiver).float() + bearing
    torch.testing.assert_close(model.predict(far)[0], law, atol=1e-3, rtol=0)


def test_groups_of_receivers_may_be_fitted_anywhere(monkeypatch):
    """Two groups fitted one after the other or by two processes of a cluster: the same bits."""
    distributed = pytest.importorskip("distributed", reason="needs the extra 'cluster'")
    monkeypatch.setattr(rssi_fit, "GROUP", 2)
    data = with_field(n=40)
    here = fit_rssi(data, QUICK)
    assert len(here.groups) == 2
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        there = fit_rssi(data, QUICK, parallel=on_cluster(cluster.scheduler_address))
    assert torch.equal(there.predict(data.transmitter_position)[0], here.predict(data.transmitter_position)[0])


def test_a_receiver_heard_just_often_enough_is_fitted():
    data = with_field()
    data.rssi_dbm[10:, 1] = torch.nan
    assert fit_rssi(data, QUICK).predict(data.transmitter_position)[0].isfinite().all()


def test_missing_values_do_not_matter_to_other_receivers():
    """A receiver heard rarely must not change what is learnt of one heard always, beyond the shared batches."""
    data = with_field()
    missing = data.rssi_dbm.clone()
    missing[20:, 2] = torch.nan
    model = fit_rssi(
        Rssi("m", data.receiver_names, data.receiver_position, data.transmitter_position, missing, data.index),
        QUICK,
    )
    assert model.predict(data.transmitter_position)[0].isfinite().all()


def test_same_seed_same_model_and_any_batch():
    data = with_field(n=60)
    a, b = (fit_rssi(data, QUICK).predict(data.transmitter_position)[0] for _ in range(2))
    assert torch.equal(a, b)
    model = fit_rssi(data, QUICK)
    torch.testing.assert_close(model.predict(data.transmitter_position, batch=7)[0], a)


def test_model_refuses(monkeypatch):
    model = fit_rssi(law_only(), QUICK)
    with pytest.raises(InputError, match="must be finite numbers"):
        model.predict(torch.tensor([[0.0, 0.0, float("nan")]]))
    rare = law_only()
    rare.rssi_dbm[9:, 1] = torch.nan
    with pytest.raises(InputError, match="'b' is heard in 9"):
        fit_rssi(rare, QUICK)
    monkeypatch.setattr(rssi_model.ReceiverGroup, "forward", lambda self, p: self.level * torch.nan + p[:, :1].float())
    with pytest.raises(FitError, match="step 0"):
        fit_rssi(law_only(), QUICK)


@pytest.mark.parametrize("name", [n for n in PREDICTORS if n.startswith(("mri", "gp"))])
def test_predictors_with_a_law_recover_it(name):
    data = law_only()
    predictor = PREDICTORS[name].make(Settings())
    predictor.fit(data)
    place = torch.tensor([[3.0, 4.0, 2.0]], dtype=torch.float64)
    assert predictor.predict(place)[0, 0].item() == pytest.approx(-50 - 20 * np.log10(5), abs=0.05)


def test_pooled_law_is_one_law():
    data = law_only()
    shifted = Rssi(
        "s",
        data.receiver_names,
        data.receiver_position,
        data.transmitter_position,
        data.rssi_dbm + torch.tensor([0.0, 3, 6]),
        data.index,
    )
    pooled = PREDICTORS["mri_pooled"].make(Settings())
    pooled.fit(shifted)
    place = torch.tensor([[5.0, 5.0, 2.0]], dtype=torch.float64)  # equally far from all receivers
    assert torch.allclose(pooled.predict(place)[0], pooled.predict(place)[0, 0])


def test_pooled_law_pools_over_all_receivers_of_the_data():
    """Asked for one receiver, it learns from the others, too."""
    data = rssi_room(n=60)
    one, every = data.receivers(["6"]), PREDICTORS["mri_pooled"].make(Settings())
    every.fit(data)
    pooled = PREDICTORS["mri_pooled"].make(Settings(pool=data))
    pooled.fit(one)
    torch.testing.assert_close(
        pooled.predict(data.transmitter_position)[:, 0], every.predict(data.transmitter_position)[:, 5]
    )


@pytest.mark.parametrize("name", list(PREDICTORS))
def test_predictors_ignore_what_was_not_heard(name):
    train, test = rssi_room(n=60).receivers(["1", "2"]).split("random")
    predictor = PREDICTORS[name].make(Settings("block"))
    predictor.fit(train)
    predicted = predictor.predict(test.transmitter_position)
    assert predicted.shape == (12, 2)
    assert predicted.isfinite().all()
    heard = ~test.rssi_dbm.isnan()
    assert (predicted - test.rssi_dbm)[heard].abs().median() < 9


def test_unknown_predictor():
    with pytest.raises(InputError, match="choose from swiftwrf"):
        PREDICTORS["forest"]


@pytest.fixture
def small(monkeypatch):
    """The task on a small floor."""
    monkeypatch.setattr(experiment, "rssi_room", lambda seed: rssi_room(n=60, seed=seed))


def run(*arguments):
    return command_line("tasks.rssi", experiment.RssiTaskConfig, experiment.run, [str(a) for a in arguments])


def test_whole_run(small, tmp_path):
    plan = tmp_path / "plan.png"
    Image.new("RGB", (40, 30), "white").save(plan)
    floor = ("--floor-plan", plan, "--floor-extent", 0, 20, 0, 16)
    assert run("--rx", "1", "receiver06", *floor, "--out", tmp_path / "run") == 0
    out = tmp_path / "run"
    metrics = json.loads((out / "metrics.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert (metrics["task"], metrics["data"], metrics["split"]) == ("rssi", "simulated-room", "random")
    assert set(metrics["overall"]) == set(PREDICTORS)
    assert set(metrics["receivers"]) == {"receiver01", "receiver06"}
    assert set(metrics["seconds"]) == {"fit", "predict"}
    errors = pd.read_csv(out / "errors.csv")
    own = errors[errors.method == "knn"].abs_error_db
    assert metrics["overall"]["knn"]["abs_error_db"]["median"] == pytest.approx(own.median())
    assert metrics["overall"]["knn"]["abs_error_db"]["n"] == len(own)
    predictions = pd.read_csv(out / "predictions.csv")
    assert list(predictions) == ["x", "y", "z", "receiver", "measured", "predicted", "low", "high"]
    assert (predictions.low <= predictions.predicted).all()
    assert "What this does not show" in (out / "report.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--rx", "99"), "no receiver '99'"),
        (("--rx", "1", "--split", "nowhere"), "choose one of block, random"),
        (("--rx", "1", "--floor-plan", "x.png"), "needs --floor-extent"),
        (("--rx", "1", "--floor-plan", "x.png", "--floor-extent", 0, 1, 0, 1), "not a readable image"),
        (("--rx", "1", "--floor-plan", "x.png", "--floor-extent", 1, 0, 0, 1), "x0 < x1"),
        (("--rx", "1", "--data", "/nowhere"), "is not a folder"),
        (("--rx", "1", "--scheduler", "tcp://127.0.0.1:1"), "no Dask scheduler"),
    ],
)
def test_wrong_input_is_one_sentence_and_code_2(small, tmp_path, capsys, arguments, says):
    assert run(*arguments, "--out", tmp_path / "run") == 2
    error = capsys.readouterr().err.strip()
    assert says in error
    assert error.count("\n") == 0
    assert not list(tmp_path.iterdir())
