"""swiftwrf plan: coverage of further access points and of changes, by a run of rssi."""

import json
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
import quick
import torch
from scipy.stats import norm
from test_receivers_run import RECEIVERS, write_hall

from swiftwrf import Rssi
from swiftwrf.contrib.survey.plan import CoveragePlan
from swiftwrf.data.coordinates import Floors
from tasks.plan import _maps


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plan")
    table, _ = write_hall(folder / "walk", known=True)
    assert quick.run("rssi", "--rx", "all", "--data", table, "--above", -72, "--out", folder / "run") == 0
    return folder / "run"


def test_a_plan_has_a_table_a_report_and_an_answer(run, tmp_path, capsys):
    assert quick.run("plan", run, "--aps", 2, "--above", -62, "--json", "--out", tmp_path / "plan") == 0
    answer = json.loads(capsys.readouterr().out)
    steps = answer["steps"]
    assert [step["step"].split(" at ")[0] for step in steps] == ["as surveyed", "access point", "access point"]
    for before, after in pairwise(steps):
        assert after["coverage"] - before["coverage"] == pytest.approx(after["gain"], abs=1e-9)
        assert after["gain_low"] <= after["gain"] <= after["gain_high"]
    table = pd.read_csv(tmp_path / "plan" / "candidates.csv")
    assert table["gain"].is_monotonic_decreasing
    assert sorted(table["chosen"].dropna()) == [1, 2]
    first = table[table["chosen"] == 1].iloc[0]
    np.testing.assert_allclose(first[["x_m", "y_m", "z_m"]].astype(float), steps[1]["position_m"], atol=1e-3)
    assert "not worth it" not in answer["conclusion"][0]
    report = (tmp_path / "plan" / "report.html").read_text()
    assert f"{steps[-1]['coverage']:.0%}" in report
    x, y = np.meshgrid(np.linspace(0.5, 39.5, 80), np.linspace(0.5, 19.5, 40))
    cell = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1.2)])
    mean = -40 - 30 * np.log10(np.linalg.norm(cell[:, None] - RECEIVERS, axis=2))
    assert steps[0]["coverage"] == pytest.approx(1 - norm.cdf((-62 - mean) / 3).prod(axis=1).mean(), abs=0.04)


def test_gains_are_said_in_points_of_coverage_at_the_threshold_of_the_run(run, tmp_path, capsys):
    assert quick.run("plan", run, "--off", "ap2", "--out", tmp_path / "plan") == 0
    said, report = capsys.readouterr().out, (tmp_path / "plan" / "report.html").read_text()
    answer = json.loads((tmp_path / "plan" / "plan.json").read_text())
    assert answer["threshold_dbm"] == -72
    off, added = answer["steps"][1:]
    assert off["gain"] < -0.02
    assert added["gain"] > 0.02
    for step in (off, added):
        gain = "{:+.1f} ({:+.1f} to {:+.1f})".format(*(100 * step[f"gain{end}"] for end in ("", "_low", "_high")))
        share = "{:.0%} ({:.0%} to {:.0%})".format(*(step[f"coverage{end}"] for end in ("", "_low", "_high")))
        assert f"{step['step']}: coverage {share}, {gain} points" in said
        assert gain in report
        assert share in report
    assert "not worth it" not in said


def test_access_points_that_add_little_are_said_not_to_be_worth_it(run, tmp_path, capsys):
    assert quick.run("plan", run, "--aps", 2, "--above", -95, "--out", tmp_path / "plan") == 0
    steps = json.loads((tmp_path / "plan" / "plan.json").read_text())["steps"]
    assert all(step["gain"] < 0.02 for step in steps[1:])
    printed = capsys.readouterr().out
    order = [
        "adds less than 2 points is not worth it: 2 of them",
        "access point at",
        "Compare your own places",
        "report: ",
    ]
    assert [printed.index(part) for part in order] == sorted(printed.index(part) for part in order)


def test_access_points_keep_their_numbers_on_the_maps_of_floors():
    """The first of three is on the upper floor, the others below."""
    at = torch.tensor([[1.0, 2.0, 1.0], [4.0, 3.0, 1.0], [2.0, 5.0, 4.0]], dtype=torch.float64)
    cells, none = at.repeat(4, 1), torch.zeros(0)
    survey = Rssi(torch.full((3, 1), -60.0), at, floors=Floors(("G", "1"), (1.0, 4.0)))
    plan = CoveragePlan(-67.0, none, none, at, none, (2, 0, 1), none, cells, torch.rand(2, 12), survey)
    numbers = [
        [{text.get_text(): text.xy for text in panel.axes[0].texts} for panel in plot.panels] for plot in _maps(plan)
    ]
    assert numbers == [[{}, {"2": (1.0, 2.0), "3": (4.0, 3.0)}], [{}, {"1": (2.0, 5.0)}]]


def test_own_places_are_compared(run, tmp_path, capsys):
    places = tmp_path / "places.csv"
    places.write_text("x,y,z\n6,10,2.5\n30,10,2.5\n")
    assert quick.run("plan", run, "--at", places, "--above", -62, "--json", "--out", tmp_path / "plan") == 0
    assert json.loads(capsys.readouterr().out)["steps"][1]["position_m"] == [30.0, 10.0, 2.5]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--aps", 0), "--aps 0 changes nothing"),
        (("--power", "ap1"), "--power takes NAME=DB"),
        (("--power", "ap1=3", "ap1=4"), "--power takes NAME=DB"),
        (("--off", "nowhere"), "has no receiver 'nowhere'"),
    ],
)
def test_wrong_options_are_refused_in_one_sentence(run, tmp_path, capsys, options, message):
    assert quick.run("plan", run, *options, "--out", tmp_path / "plan") == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "plan").exists()


def test_a_run_of_another_task_is_refused(tmp_path, capsys):
    (tmp_path / "metrics.json").write_text("{}")
    (tmp_path / "config.json").write_text('{"task": "aoa"}')
    assert quick.run("plan", tmp_path, "--out", tmp_path / "plan") == 2
    assert "is no run of swiftwrf rssi" in capsys.readouterr().err
