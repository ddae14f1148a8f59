"""The predictors of RSSI and their task."""

import json
import re
import shlex
from dataclasses import replace
from html import unescape
from importlib.metadata import EntryPoint
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import quick
import torch
from PIL import Image
from samples import write_survey
from sklearn.model_selection import GridSearchCV, PredefinedSplit
from sklearn.neighbors import KNeighborsRegressor
from test_rssi_model import path_loss_only

from swiftwrf import rssi_room
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.contrib.comparison.parts import pool_of
from swiftwrf.contrib.comparison.predictors import make_predictor
from swiftwrf.contrib.comparison.rssi_baselines import NEIGHBOUR_COUNTS
from swiftwrf.data.splits import folds
from swiftwrf.rssi import RssiPredictor, compare
from swiftwrf.runtime import registry
from tasks.page.maps import FloorPlan
from tasks.records import Records
from tasks.report import merge
from tasks.rssi import experiment
from tasks.rssi.coverage import coverage_sentence
from tasks.rssi.differences import where_methods_differ
from tasks.rssi.maps import Maps
from tasks.rssi.page import _maps, answer, where_next


@pytest.mark.parametrize("name", [n for n in RSSI_PREDICTORS if n.startswith(("mri", "gp"))])
def test_predictors_with_a_path_loss_model_recover_it(name):
    position = torch.tensor([[3.0, 4.0, 2.0]], dtype=torch.float64)
    predictor = make_predictor(name).fit(path_loss_only())
    assert predictor.predict(position).mean[0, 0].item() == pytest.approx(-50 - 20 * np.log10(5), abs=0.05)


def test_shared_path_loss_model_is_one_model():
    data = path_loss_only()
    shifted = replace(data, rssi_dbm=data.rssi_dbm + torch.tensor([0.0, 3, 6]))
    position = torch.tensor([[5.0, 5.0, 2.0]], dtype=torch.float64)  # equally far from all receivers
    predicted = make_predictor("mri_pooled").fit(shifted).predict(position).mean[0]
    assert torch.allclose(predicted, predicted[0])


def test_shared_path_loss_model_is_of_all_receivers_of_the_pool():
    data = rssi_room(n=60)
    every = make_predictor("mri_pooled").fit(data).predict(data.transmitter_position).mean
    one = make_predictor("mri_pooled").fit(data.receivers(["6"]), pool=data).predict(data.transmitter_position).mean
    torch.testing.assert_close(one[:, 0], every[:, 5])


def test_a_predictor_of_another_package(monkeypatch):
    """Registered by an entry point, it takes part in a comparison."""
    point = EntryPoint("outside", "test_rssi:Outside", "swiftwrf.rssi_predictors")
    monkeypatch.setattr(registry, "_entry_points", lambda group, path: (point,) if group == point.group else ())
    monkeypatch.setattr(RSSI_PREDICTORS, "_registered", {name: RSSI_PREDICTORS[name] for name in ("swiftwrf", "mean")})
    found = compare(rssi_room(n=40), receivers=["1"])
    assert {*found.summary().index} == {"swiftwrf", "mean", "outside"}


class Outside(RssiPredictor):
    """Always -70 dBm."""

    name = "outside"

    def _fit(self, train, **_):
        self.n = len(train.receiver_names)

    def _predict(self, position):
        return torch.full((len(position), self.n), -70.0), None


@pytest.fixture
def small(monkeypatch):
    """The task on a small floor."""
    monkeypatch.setattr(experiment, "rssi_room", lambda seed: rssi_room(n=60, seed=seed))
    monkeypatch.setattr("swiftwrf.rssi.maps.CELLS", 8)


def run(*arguments):
    return quick.command("rssi", *arguments)


def test_a_floor_plan_whose_pixels_are_the_positions_needs_no_extent(tmp_path):
    Image.new("RGB", (400, 300), "white").save(tmp_path / "plan.png")
    config = SimpleNamespace(floor_plan=str(tmp_path / "plan.png"), floor_extent=None)
    assert FloorPlan.stated(config, "walk", 20.0).corners == (0, 20, -15, 0)


def test_whole_run(small, small_published, tmp_path):
    plan = tmp_path / "plan.png"
    Image.new("RGB", (40, 30), "white").save(plan)
    floor = ("--floor-plan", plan, "--floor-extent", 0, 20, 0, 16)
    with quick.sketched():
        assert run("--rx", "1", "receiver06", *floor, "--also", "nerf2", "--out", tmp_path / "run") == 0
    out = tmp_path / "run"
    metrics = json.loads((out / "metrics.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert set(metrics["overall"]) == set(RSSI_PREDICTORS) - {"pairs", "knn_pairs"}  # which are for two moving ends
    assert set(metrics["receivers"]) == {"receiver01", "receiver06"}
    assert set(metrics["seconds"]) == {"fit", "predict"}
    predictions = pd.read_csv(out / "predictions.csv")
    assert list(predictions) == ["x", "y", "z", "receiver", "measured", "predicted", "low", "high"]
    assert (predictions.low <= predictions.predicted).all()
    assert "What this does not show" in (out / "report.html").read_text()
    assert list((out / "figures").glob("map-*.svg"))


def test_a_lone_receiver_has_one_map_and_no_average(tmp_path, capsys):
    out = tmp_path / "her 'own' run"
    assert quick.run("rssi", "--rx", "1", "--out", out) == 0
    drawn = {file.stem.partition("-")[0] for file in (out / "figures").glob("*.svg")}
    assert drawn == {"coverage", "summary", "errors", "where"}
    assert list((out / "figures").glob("summary*.csv"))
    for text in (capsys.readouterr().out, unescape(re.sub("<[^>]*>", "", (out / "report.html").read_text()))):
        assert f"swiftwrf view {shlex.quote(str(out))}" in text
        assert f"swiftwrf predict {shlex.quote(str(out))} positions.csv" in text
        assert "--split block" in text


def test_a_survey_table_is_one_command_to_a_map(tmp_path):
    file = write_survey(tmp_path / "walk")
    assert quick.run("rssi", "--data", file, "--rx", "all", "--out", tmp_path / "run") == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert set(metrics["overall"]) == {"swiftwrf", "mean"}
    assert set(metrics["left_out"]) == {"mri_pooled", "mri_receiver"}
    report = (tmp_path / "run" / "report.html").read_text()
    assert "Left out: mri_pooled needs the positions of the receivers" in report
    with np.load(tmp_path / "run" / "maps.npz") as maps:
        assert np.isfinite(maps["predicted"]).all()
    with quick.sketched():
        merge([tmp_path / "run"], tmp_path / "merged")


def test_neighbours_are_those_that_a_grid_search_chooses():
    data = rssi_room(n=150)
    fold = folds(data.transmitter_position, "random", 0).numpy()
    position, predictor = data.transmitter_position.numpy(), make_predictor("knn")
    for values in data.rssi_dbm.numpy().T[:2]:
        detected = ~np.isnan(values)
        x, y, own = position[detected], values[detected], fold[detected]
        grid = {"n_neighbors": [k for k in NEIGHBOUR_COUNTS if k <= 100], "weights": ["uniform", "distance"]}
        search = GridSearchCV(KNeighborsRegressor(), grid, scoring="neg_mean_absolute_error", cv=PredefinedSplit(own))
        found = predictor._regressor(x, y, own)
        assert {"n_neighbors": found.n_neighbors, "weights": found.weights} == search.fit(x, y).best_params_


def made_run(tmp_path, **changes):
    """A run of one receiver, or several, on one floor of 5 x 4 cells, between four corners that were measured."""
    corners = np.array([[0, 0, 1], [4, 0, 1], [0, 3, 1], [4, 3, 1]], dtype=float)
    level = np.full((1, 1, 4, 5), -60.0)
    maps = {
        "x": np.arange(5.0),
        "y": np.arange(4.0),
        "predicted": level,
        "width": 0 * level + 7,
        "detection": 0 * level + 1,
    }
    maps |= {"above": level[:, 0], "inside": level[:, 0] < 0, "known": level[:, 0] < 0, "receiver": corners[:1]}
    maps |= {"measured_position": corners, "measured": corners[:, :1], "floor_of_row": np.zeros(4, int)}
    maps |= {"floor_names": np.array([""]), "receiver_names": np.array(["a"])} | changes
    tested = pd.DataFrame({"x": np.arange(5.0), "y": 0.0, "z": 1.0, "receiver": "a", "measured": -60.0})
    tables, coverage = {"predictions": tested}, [{"reach_m": 2.0}] * len(maps["floor_names"])
    return SimpleNamespace(
        arrays=lambda name: maps,
        table=tables.__getitem__,
        tables=tables,
        maps=maps,
        file_name="run",
        folder=tmp_path,
        metrics={"coverage": coverage},
    )


def test_an_interval_of_one_width_sends_nobody_to_measure(tmp_path):
    run = made_run(tmp_path)
    assert where_next(run).startswith("Measure at more positions: 4 are too few")
    position = np.concatenate([run.maps["measured_position"], np.linspace([0, 0, 1], [4, 3, 1], 30)])
    run.maps |= {"measured_position": position, "measured": position[:, :1], "floor_of_row": np.zeros(34, int)}
    assert "would hardly narrow the 80% interval: it is about 7 dB wide, and less than 1.2 times as wide" in where_next(
        run
    )
    assert "the model explains no more" in where_next(run)
    for spread, reason in ((2.7, "which is the scatter of repeated"), (0.5, "lie within 1 dB")):
        measured = [-60.0 - spread, -60 + spread] * 20
        run.tables["predictions"] = pd.DataFrame({"x": 1.0, "y": 0.0, "z": 1.0, "receiver": "a", "measured": measured})
        assert reason in where_next(run)
    run.tables["predictions"]["x"] = np.arange(40.0)  # no place was measured twice
    assert "at one place" not in where_next(run)


def test_where_the_best_server_is_uncertain_is_where_to_measure(tmp_path):
    """The mean over receivers is 9.5 dB in all cells; the picture shows that of the stronger one."""
    predicted = np.stack([np.full((4, 5), dbm) for dbm in (-50.0, -70.0)])[None]
    width = np.stack([np.full((4, 5), 9.0), np.full((4, 5), 10.0)])[None]
    width[0, :, 2, 3] = 14.0, 5.0
    fields = {"predicted": predicted, "width": width, "detection": np.ones_like(width), "measured": np.zeros((4, 2))}
    run = made_run(tmp_path, **fields, receiver_names=np.array(["a", "b"]), receiver=np.full((2, 3), np.nan))
    assert width.mean(axis=1).max() == width.mean(axis=1).min()
    sentence = (
        "Measure around x = 3.0 m, y = 2.0 m (14 dB instead of 9 dB): the 80% interval of the best receiver is widest"
    )
    assert where_next(run).startswith(sentence)
    assert [ax.get_title() for panel in Maps(run).summary().panels for ax in panel.axes[:1]] == ["best receiver"] * 2
    run.maps["inside"] = run.maps["inside"] & (np.arange(5) < 3)  # x = 3 is outside now
    assert "4 are too few" in where_next(run)
    assert "about 9 dB in the whole measured area" in Maps(run).summary().caption


def test_cells_that_are_not_measured_are_hatched(tmp_path, monkeypatch):
    hatched = []
    monkeypatch.setattr(
        "tasks.rssi.maps.hatch", lambda ax, x, y, where, pattern="////": hatched.append((pattern, where))
    )
    known = np.arange(20).reshape(1, 4, 5) % 3 == 0
    detection = np.where(np.arange(5) < 2, 0.4, 0.6) * np.ones((1, 1, 4, 5))
    width = np.where(np.arange(5) < 4, 7.0, 8.5) * np.ones((1, 1, 4, 5))
    run = made_run(tmp_path, known=known, detection=detection, width=width)
    plots = [Maps(run).summary(), *(Maps(run).by_receiver(kind) for kind in ("predicted", "width"))]
    assert [pattern for pattern, _ in hatched] == ["////", "\\\\\\\\"] * 4
    for pattern, where in hatched:
        np.testing.assert_array_equal(where, ~known[0] if pattern == "////" else detection[0, 0] < 0.5)
    for plot in plots:
        assert "Hatched like /: not measured, outside the scans or more than 2.0 m from any scan" in plot.caption
        assert plot.data["measured"].tolist() == known.ravel().tolist()
    run.metrics["coverage"][0]["reach_m"] = None
    assert "Hatched like /: not measured, outside the scans; like" in Maps(run).summary().caption


def test_widths_are_drawn_at_receivers_where_they_vary(tmp_path):
    width = np.full((1, 3, 4, 5), 10.0)
    width[0, 0, 0, 0], width[0, 2, 1, 2] = 11.9, 12.1  # 1.2 times the median is drawn
    level = np.full((1, 3, 4, 5), -60.0)
    names, measured = np.array(["a", "b", "c"]), np.full((4, 3), -60.0)
    run = made_run(
        tmp_path, predicted=level, width=width, detection=0 * level + 1, receiver_names=names, measured=measured
    )
    plot = Maps(run).by_receiver("width")
    assert [panel.axes[0].get_title() for panel in plot.panels] == ["c"]
    assert set(plot.data["receiver"]) == {"c"}
    run.maps["width"] = width.clip(max=11.9)
    assert Maps(run).by_receiver("width") is None
    assert len(Maps(run).by_receiver("predicted").panels) == 3


def test_the_mean_is_recommended_where_the_model_is_behind_it_on_held_out_rows(rssi_run):
    run = Records(rssi_run)
    held_out = run.metrics["held_out"]
    assert set(held_out) == {"swiftwrf", "mean"}
    assert answer(run).chosen == min(held_out, key=held_out.get)
    run.metrics["held_out"] = {"swiftwrf": 3.25, "mean": 3.5}
    assert answer(run).chosen == "swiftwrf"
    assert "above -75 dBm" in answer(run).conclusion[0]
    run.metrics["held_out"] = {"swiftwrf": 3.75, "mean": 3.5}
    found = answer(run)
    assert found.chosen == "mean"
    assert {"swiftwrf", "mean"} <= {one.name for one in found.short()[0]}
    assert "3.50 dB" in found.conclusion[0]
    assert "3.75 dB" in found.conclusion[0]


def test_each_floor_has_its_maps_its_rows_and_its_widest_place(tmp_path):
    corners = np.array([[0, 0, 0], [4, 0, 0], [0, 3, 0], [4, 3, 0]], dtype=float)
    position = np.concatenate([corners, corners + np.array([0, 0, 4])])
    level = np.stack([np.full((1, 4, 5), dbm) for dbm in (-50.0, -90.0)])
    width = np.full((2, 1, 4, 5), 7.0)
    width[0, 0, 1, 2], width[1, 0, 3, 4] = 14.0, 21.0
    fields = {name: np.ones((2, 4, 5), bool) for name in ("inside", "known")} | {"above": level[:, 0]}
    fields |= {"predicted": level, "width": width, "detection": 0 * level + 1, "measured": position[:, 2:]}
    fields |= {"measured_position": position, "floor_of_row": np.repeat([0, 1], 4)}
    run = made_run(tmp_path, **fields, floor_names=np.array(["Ground floor", "1"]))
    maps, (ground, first) = run.maps, Maps.of_floors(run)
    assert (ground.place, first.place) == ("the measured area of Ground floor", "the measured area of floor 1")
    assert first.titled("a") == "a, 1"
    assert where_next(run).startswith(
        "Measure around x = 2.0 m, y = 1.0 m on Ground floor (14 dB instead of 7 dB), "
        "x = 4.0 m, y = 3.0 m on floor 1 (21 dB instead of 7 dB): the 80% interval is widest there"
    )
    assert first.arrays["measured"].ravel().tolist() == [4.0] * 4
    assert first.summary().name == "summary-1"
    maps["y"] = np.arange(4.0) / 20  # a corridor, which would be a line to scale
    assert Maps(run, 1).summary().panels[0].axes[0].get_aspect() == "auto"
    assert [first.by_receiver(kind).name for kind in ("predicted", "width")] == ["map-run-1", "width-run-1"]
    maps["measured"] = np.where(position[:, 2:] > 0, np.nan, -50.0)  # the first floor receives nothing
    _, first = Maps.of_floors(run)
    low, high = first.summary().panels[0].axes[0].images[0].get_clim()
    assert -100 < low < -90 < high < -80


def test_a_measured_area_without_cells_has_no_coverage(tmp_path):
    found = {"covered": None, "not_covered": None, "uncertain": None, "not_measured": None, "scans_above": None}
    assert coverage_sentence(found | {"n_scans": 0}, "a above -75 dBm") == "No cell of the map is in the measured area."


@pytest.mark.parametrize("seed", [0, 1])
def test_receivers_that_a_split_by_place_holds_out_are_not_in_the_pool(seed):
    whole = rssi_room(n=120)
    data = whole.receivers([str(number) for number in range(7, 13)])
    train, test = data.split("place", seed)
    pool = pool_of(whole, train, test, "place", seed)
    held_out = [name for name, out in zip(test.receiver_names, test.detected.any(dim=0), strict=True) if out]
    assert held_out
    assert not pool.detected[:, [pool.receiver_names.index(name) for name in held_out]].any()
    assert torch.equal(pool.transmitter_position, train.transmitter_position)
    assert int(pool.detected.any(dim=0).sum()) == len(whole.receiver_names) - len(held_out)


def test_the_table_of_differences_is_that_of_the_errors(rssi_run):
    run = Records(rssi_run)
    table, errors = where_methods_differ(run, answer(run)), pd.read_csv(rssi_run / "errors.csv")
    own = errors[errors["method"] == "swiftwrf"]
    measured, predicted = own["measured_dbm"].to_numpy(), own["predicted_dbm"].to_numpy()
    apart = own["from_training_m"].to_numpy()
    (cells,) = [row for row in table.rows if row[0] == "swiftwrf"]
    weak, strong = np.quantile(measured, 0.25), np.quantile(measured, 0.75)
    far = apart >= np.quantile(apart, 0.75)
    expected = [(predicted - measured)[part].mean() for part in (measured <= weak, measured >= strong)]
    expected.append(np.abs(predicted - measured)[far].mean())
    assert [float(cell) for cell in cells[1:4]] == pytest.approx(expected, abs=0.06)
    shown = [float(re.search(r"(-\d\S*) dBm", column)[1]) for column in table.columns[1:3]]
    assert shown == pytest.approx([weak, strong], abs=0.06)
    assert len(cells) == len(table.columns)


def floors_of_a_building(tmp_path, n_receivers=20):
    """A run of three floors whose receivers are the stronger, the higher their number."""
    generator = np.random.default_rng(0)
    position = np.concatenate([np.c_[generator.random((30, 2)) * (4, 3), np.full(30, 4.0 * n)] for n in range(3)])
    shape = (3, n_receivers, 4, 5)
    level = -90.0 + np.arange(n_receivers)[:, None, None] + generator.random(shape)
    every = np.ones((3, 4, 5), bool)
    fields = {
        "predicted": level,
        "width": level + 100,
        "detection": 0 * level + 1,
        "above": generator.random((3, 4, 5)),
    }
    fields |= {"inside": every, "known": every, "measured_position": position, "floor_of_row": np.repeat([0, 1, 2], 30)}
    names = np.array([f"r{number}" for number in range(n_receivers)])
    fields |= {"measured": generator.random((90, n_receivers)) - 80, "receiver_names": names}
    run = made_run(
        tmp_path, **fields, receiver=np.full((n_receivers, 3), np.nan), floor_names=np.array(["0", "1", "2"])
    )
    shares = {"threshold_dbm": -75.0, "certainty": 0.9, "covered": 0.25, "not_covered": 0.15, "uncertain": 0.6}
    for each in run.metrics["coverage"]:
        each |= shares | {"not_measured": 0.0}
    spots = [{"floor": str(n), "x_m": 1.0 + n, "y_m": 1.0, "threshold_dbm": -75.0} for n in (2, 0)]
    run.tables["weak_spots"] = pd.DataFrame([*spots, spots[0] | {"threshold_dbm": -60.0}])
    return run


def test_floors_have_maps_of_one_size_the_strongest_receivers_first(tmp_path):
    run = floors_of_a_building(tmp_path)
    floors = Maps.of_floors(run)
    section = _maps(run, "predicted")
    assert [part.title for part in section.parts] == ["floor 0", "floor 1", "floor 2"]
    for part in section.parts:
        titles = [panel.axes[0].get_title() for panel in part.plots[1].panels]
        assert titles == [f"r{number}" for number in (19, 18, 17, 16, 15, 14)]
        (more,) = part.parts
        assert more.folded
        assert [panel.axes[0].get_title() for panel in more.plots[0].panels] == ["r13", "r12", "r11", "r10"]
    drawn = [panel for part in section.parts for panel in part.plots[1].panels]
    assert len({tuple(panel.get_size_inches()) for panel in drawn}) == 1
    coverage = Maps.coverage_plot(floors)
    assert [panel.axes[0].get_title() for panel in coverage.panels] == ["floor 0", "floor 1", "floor 2"]
    assert len({tuple(panel.get_size_inches()) for panel in coverage.panels}) == 1
    marks = [[text.get_text() for text in panel.axes[0].texts] for panel in coverage.panels]
    assert marks == [["1"], [], ["1"]]
    classes = np.array(["not covered", "uncertain", "covered"])[np.digitize(run.maps["above"], [0.1, 0.9])]
    assert coverage.data["coverage"].tolist() == classes.ravel().tolist()
    for floor, panel in enumerate(coverage.panels):
        said = [text.get_text() for text in panel.legends[0].get_texts()]
        shares = run.metrics["coverage"][floor]
        named = {"covered": "covered", "uncertain": "uncertain", "not covered": "not_covered"}
        assert said == [*(f"{name} {shares[key]:.0%}" for name, key in named.items()), "not measured"]


def test_only_the_named_predictors_are_compared(tmp_path, capsys):
    assert quick.run("rssi", "--rx", 6, "--only", "mri_receiver", "--out", tmp_path / "run") == 0
    errors = pd.read_csv(tmp_path / "run" / "errors.csv")
    assert set(errors["method"]) == {"swiftwrf", "mean", "mri_receiver"}
    assert quick.run("rssi", "--only", "nearest", "--out", tmp_path / "other") == 2
    assert "nearest" in capsys.readouterr().err


def test_a_report_has_its_figures_as_pdf(rssi_run, tmp_path):
    merge([rssi_run], tmp_path / "report", pdf=True)
    figures = tmp_path / "report" / "figures"
    drawn = {file.stem for file in figures.glob("*.svg")}
    assert drawn
    assert {file.stem for file in figures.glob("*.pdf")} == drawn
    assert all(file.read_bytes().startswith(b"%PDF") for file in figures.glob("*.pdf"))
