"""The localizers, their experiment, and positions of new observations."""

import json
from dataclasses import replace
from hashlib import sha256
from unittest import mock

import numpy as np
import pandas as pd
import pytest
import quick
import torch
from quick import said
from small import FLOOR, known_planes

from swiftwrf import AngularGrid, InputError, load, rssi_room, simulated_room
from swiftwrf.contrib.comparison.localizers import LOCALIZERS
from swiftwrf.contrib.comparison.locating import LocateComparison
from swiftwrf.contrib.comparison.steps import LOCATOR as MODEL
from swiftwrf.data.writing import write_spectra
from swiftwrf.locate import MatchedField
from tasks.locate.page import answer, page
from tasks.predict import read_rssi
from tasks.records import Records
from tasks.source import Reading, aligned

GRID = AngularGrid.hemisphere(8, 32)


def run(*arguments):
    """The experiment with cheap radio maps; its exit code."""
    return quick.run("locate", *arguments)


def strict_json(file):
    return json.loads(file.read_text(), parse_constant=lambda name: pytest.fail(name))


def write_rssi(file, data, located=True):
    table = pd.DataFrame(data.rssi_dbm.numpy(), columns=list(data.receiver_names))
    if located:
        table[["x", "y", "z"]] = data.transmitter_position.numpy()
    table.to_csv(file, index=False)
    return file


@pytest.fixture(scope="module")
def matched(tmp_path_factory):
    """Spectra of the built-in room, and the file of a coarse locator that was fitted to them."""
    data = simulated_room(n=40, grid=GRID)
    file = tmp_path_factory.mktemp("matched") / "matched.safetensors"
    with known_planes(FLOOR):
        MatchedField(max_cells=200, n_best=20, n_background=10, n_rounds=1).fit(data).save(file)
    return data, file


@pytest.mark.parametrize("name", [name for name in LOCALIZERS if name != "posterior"])
@pytest.mark.parametrize("validation", ["random", "block"])
def test_baselines_locate_better_than_the_mean_position(name, validation):
    train, test = rssi_room(n=150).split()
    located = LOCALIZERS[name](validation=validation).fit(train).locate(test.rssi_dbm)
    error = (located.position - test.transmitter_position).norm(dim=1)
    spread = (train.transmitter_position.mean(dim=0) - test.transmitter_position).norm(dim=1)
    assert float(error.mean()) <= (1 if name == "mean" else 0.85) * float(spread.mean()) + 1e-9
    assert located.radius is None


def test_a_known_fingerprint_is_located_where_it_was_measured():
    train = rssi_room(n=60)
    located = LOCALIZERS["nearest"]().fit(train).locate(train.rssi_dbm)
    torch.testing.assert_close(located.position, train.transmitter_position)


def test_differences_are_robust_to_the_offset_of_a_device():
    train, test = rssi_room(n=100).split()
    for name, is_robust in (("knn_difference", True), ("knn", False)):
        localizer = LOCALIZERS[name]().fit(train)
        one, other = (localizer.locate(test.rssi_dbm + offset).position for offset in (0.0, 8.0))
        assert torch.allclose(one, other, atol=1e-3) == is_robust


def test_test_rows_reach_no_fit():
    given = LocateComparison.of(rssi_room(n=60), "random", 50, 0)
    moved = replace(given, test=replace(given.test, transmitter_position=given.test.transmitter_position + 5))
    for name in ("knn", "knn_difference", "gp"):
        values = [one.fit(None, name) for one in (given, moved)]
        torch.testing.assert_close(values[0]["estimate"], values[1]["estimate"])


def test_whole_run(locate_run):
    metrics = strict_json(locate_run / "metrics.json")
    assert (metrics["n_train"], metrics["n_test"], metrics["n_receivers"], metrics["n_undetected"]) == (64, 16, 12, 0)
    assert list(metrics["overall"]) == list(LOCALIZERS)
    assert set(metrics["weights"]) == {"values", "detections", "fingerprints"}
    errors = pd.read_csv(locate_run / "errors.csv")
    assert errors.groupby("method").size().to_dict() == dict.fromkeys(LOCALIZERS, 16)
    own = errors[errors.method == "posterior"]
    away = own[["x_m", "y_m", "z_m"]].to_numpy() - own[["truth_x_m", "truth_y_m", "truth_z_m"]].to_numpy()
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), own.position_error_m)
    assert own.credible_radius_50_m.lt(own.credible_radius_95_m).all()


def test_the_report_shows_errors_calibration_and_posteriors(locate_run):
    page = (locate_run / "report.html").read_text()
    assert "best nearest-neighbour fingerprinting" in page
    assert "What this does not show" in page
    assert f"swiftwrf predict {locate_run} SOURCE" in page
    drawn = {file.stem.partition("-")[0] for file in (locate_run / "figures").glob("*.svg")}
    assert drawn == {"summary", "errors", "calibration", "posteriors"}
    with np.load(locate_run / "maps.npz") as maps:
        assert maps["density"].shape == (6, len(maps["y"]), len(maps["x"]))
        assert np.nanmax(maps["density"], axis=(1, 2)) == pytest.approx(1)


def test_posteriors_lie_on_the_floor_plan(locate_run):
    panels = [panel for plot in page([Records(locate_run)]).plots if "posteriors" in plot.name for panel in plot.panels]
    assert len(panels) == 6
    for panel in panels:
        density, plan = panel.axes[0].images
        assert list(plan.get_extent()) == [0, 20, 0, 15]
        assert plan.get_zorder() < density.get_zorder()


def test_the_mean_position_is_recommended_where_the_posterior_is_behind_it_on_held_out_rows(locate_run):
    run = Records(locate_run)
    assert answer(run).chosen == "posterior"
    assert answer(run).conclusion[0].startswith("Positions are found within")
    held_out = run.metrics["held_out"]
    assert held_out["posterior"] < held_out["mean"]
    run.metrics["held_out"] = {"posterior": 8.25, "mean": 7.5}
    found = answer(run)
    assert found.chosen == "mean"
    assert "mean" in {one.name for one in found.short()[0]}
    assert "8.25 m" in found.conclusion[0]
    assert "7.50 m" in found.conclusion[0]


def test_rows_that_no_receiver_detected_are_left_out(tmp_path, capsys):
    data = rssi_room(n=80)
    data.rssi_dbm[::4] = torch.nan
    write_rssi(tmp_path / "walk.csv", data)
    out = tmp_path / "run"
    assert run("--data", tmp_path / "walk.csv", "--rx", "1", "2", "3", "--cells", 100, "--out", out) == 0
    metrics = strict_json(out / "metrics.json")
    assert metrics["n_undetected"] > 0
    assert metrics["n_test"] + metrics["n_undetected"] == 16
    assert f"test rows that no receiver detected are left out: {metrics['n_undetected']}" in capsys.readouterr().err
    data.rssi_dbm[:70] = torch.nan
    with pytest.raises(InputError, match="at least 20 are needed"):
        LocateComparison.of(data, "random", 100, 0)
    with pytest.raises(InputError, match="split 'place' tests other receivers than it trains; choose random or block"):
        LocateComparison.of(data, "place", 100, 0)


def test_positions_of_new_rows(locate_run, tmp_path, capsys):
    test = rssi_room(n=80).subset(torch.tensor(pd.read_csv(locate_run / "errors.csv")["index"].unique()))
    known = write_rssi(tmp_path / "known.csv", test)
    unknown = write_rssi(tmp_path / "unknown.csv", test.columns([3, 0, 1, 2, *range(4, 12)]), located=False)
    assert quick.command("predict", locate_run / MODEL, known, "--out", tmp_path / "positions.csv") == 0
    assert "16 positions, median error" in capsys.readouterr().out
    assert quick.command("predict", locate_run / MODEL, unknown, "--out", tmp_path / "unknown_positions.csv") == 0
    assert "16 positions: " in capsys.readouterr().out
    found, other = pd.read_csv(tmp_path / "positions.csv"), pd.read_csv(tmp_path / "unknown_positions.csv")
    columns = ["index", "x_m", "y_m", "z_m", "std_x_m", "std_y_m", "std_z_m", "credible_radius_80_m", "ambiguous"]
    assert list(other) == columns
    assert list(found) == [*columns, "truth_x_m", "truth_y_m", "truth_z_m", "position_error_m"]
    pd.testing.assert_frame_equal(found[columns], other)
    errors = pd.read_csv(locate_run / "errors.csv").query("method == 'posterior'")
    assert found.equals(found.round(dict.fromkeys([c for c in found if c.endswith("_m")], 3)))
    np.testing.assert_allclose(found.position_error_m, errors.position_error_m, atol=5.001e-4)


def test_receivers_of_the_model_are_found_by_name(locate_run, capsys):
    data = rssi_room(n=80)
    some = replace(data.columns([1, 0]), receiver_names=("receiver02", "kitchen"))
    locator = load(locate_run / MODEL)
    placed = aligned(some, locator.model, ignore_others=True)
    assert placed.receiver_names == locator.receiver_names
    torch.testing.assert_close(placed.rssi_dbm[:, 1], data.rssi_dbm[:, 1], equal_nan=True)
    assert placed.detected[:, 2:].sum() == 0
    torch.testing.assert_close(placed.receiver_position[1], data.receiver_position[1])
    assert placed.receiver_position[[0, 2]].isnan().all()
    printed = " ".join(capsys.readouterr().err.split())
    assert "count as not detecting: receiver01" in printed
    assert "are not used: kitchen" in printed


def test_a_table_without_positions(tmp_path):
    data, is_known = read_rssi(Reading(str(write_rssi(tmp_path / "a.csv", rssi_room(n=20), located=False))))
    assert (len(data), len(data.receiver_names), is_known) == (20, 12, False)
    long = pd.DataFrame({"receiver": ["a", "b", "a"], "time": [1, 1, 2], "rssi": [-50, -60, -55]})
    long.to_csv(tmp_path / "b.csv", index=False)
    data, is_known = read_rssi(Reading(str(tmp_path / "b.csv")))
    assert (len(data), is_known) == (2, False)
    assert read_rssi(Reading(str(write_rssi(tmp_path / "c.csv", rssi_room(n=20)))))[1]


def test_other_rows_are_refused(locate_run, tmp_path, capsys):
    data, out = rssi_room(n=20), tmp_path / "out.csv"
    others = write_rssi(tmp_path / "a.csv", replace(data, receiver_names=tuple("abcdefghijkl")))
    assert quick.command("predict", locate_run / MODEL, others, "--out", out) == 2
    assert "has other receivers (a, b" in said(capsys)
    (tmp_path / "a.csv.reading.yaml").write_text("every: 2")
    assert quick.command("predict", locate_run / MODEL, others, "--out", out) == 2
    assert "takes no every" in said(capsys)
    assert not out.exists()


def test_no_receiver_detected(locate_run, tmp_path, capsys):
    data = rssi_room(n=20)
    data.rssi_dbm[:] = torch.nan
    with mock.patch("tasks.predict.read_rssi", return_value=(data, True)):
        assert quick.command("predict", locate_run / MODEL, "walk", "--out", tmp_path / "out.csv") == 2
    assert "no receiver detected the transmitter" in said(capsys)
    data.rssi_dbm[3] = -70.0
    with mock.patch("tasks.predict.read_rssi", return_value=(data, True)):
        assert quick.command("predict", locate_run / MODEL, "walk", "--out", tmp_path / "out.csv") == 0
    assert "left out: 19" in capsys.readouterr().err
    assert pd.read_csv(tmp_path / "out.csv")["index"].tolist() == [3]


def test_receivers_that_moved_are_refused(locate_run, tmp_path, capsys):
    data = rssi_room(n=20)
    moved = replace(data, receiver_position=data.receiver_position + torch.tensor([0.0, 2.0, 0.0]))
    with mock.patch("tasks.predict.read_rssi", return_value=(moved, True)):
        assert quick.command("predict", locate_run / MODEL, "walk", "--out", tmp_path / "out.csv") == 2
    assert "receiver01 2 m away from its position" in said(capsys)


def test_positions_and_directions_of_spectra(matched, tmp_path, capsys):
    data, file = matched
    (tmp_path / "data").mkdir()
    write_spectra(data, tmp_path / "data")
    assert quick.command("predict", file, tmp_path / "data", "--out", tmp_path / "known.csv") == 0
    assert "40 positions, median error" in capsys.readouterr().out
    known = pd.read_csv(tmp_path / "known.csv")
    assert known.great_circle_deg.between(0, 180).all()
    assert known.position_error_m.median() < 2
    np.save(tmp_path / "unknown.npy", data.spectrum.numpy()[:5])
    assert quick.command("predict", file, tmp_path / "unknown.npy", "--out", tmp_path / "unknown.csv") == 0
    unknown = pd.read_csv(tmp_path / "unknown.csv")
    assert list(unknown)[-2:] == ["azimuth_deg", "elevation_deg"]
    assert len(unknown) == 5


def test_rooms_of_rows_are_counted_and_predicted(tmp_path, capsys):
    """The confusion table of the report, of the files of the run; new rows get the rooms beside them."""
    out, data = tmp_path / "run", rssi_room(n=60)
    corners = [(0, 0, "west"), (10, 0, "west"), (10, 16, "west"), (0, 16, "west")]
    corners += [(10, 0, "east"), (20, 0, "east"), (20, 16, "east"), (10, 16, "east")]
    pd.DataFrame(corners, columns=["x", "y", "room"]).to_csv(tmp_path / "rooms.csv", index=False)
    source = write_rssi(tmp_path / "walk.csv", data)
    assert run("--data", source, "--out", out) == 0
    read = json.loads((out / "environment.json").read_text())["input_sha256"]
    assert read["rooms.csv"] == sha256((tmp_path / "rooms.csv").read_bytes()).hexdigest()
    table, errors = pd.read_csv(out / "rooms.csv"), pd.read_csv(out / "errors.csv")
    own = errors[errors["method"] == "posterior"]
    assert table["index"].tolist() == own["index"].tolist()
    truth = np.where(own["truth_x_m"] < 10, "west", "east")
    assert table["truth_room"].tolist() == truth.tolist()
    assert np.allclose(table["probability_west"] + table["probability_east"] + table["probability_outside"], 1)
    assert (table["room"] == np.where(table["probability_west"] > table["probability_east"], "west", "east")).all()
    cells = [(truth == one) & (table["room"] == other) for one in ("west", "east") for other in ("west", "east")]
    counts = [str(int(cell.sum())) if cell.sum() else "" for cell in cells]
    report = (out / "report.html").read_text()
    rows = [f"<td>{name}</td><td>{a}</td><td>{b}</td>" for name, a, b in (("west", *counts[:2]), ("east", *counts[2:]))]
    assert all(row in report for row in rows)
    assert f"true one in {(table['room'] == truth).mean():.0%} of {len(table)} test rows" in capsys.readouterr().out
    assert quick.command("predict", out, source, "--out", tmp_path / "located.csv") == 0
    located = pd.read_csv(tmp_path / "located.csv").set_index("index").loc[table["index"]]
    assert located["room"].tolist() == table["room"].tolist()
    np.testing.assert_allclose(located["room_probability"], table["room_probability"], atol=1e-6)
