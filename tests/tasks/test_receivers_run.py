"""Receivers of unknown position in a run, and the positions that it suggests to measure next."""

import json
import re

import numpy as np
import pandas as pd
import quick
import torch

from augment.suggest import suggest_scans
from swiftwrf import Rssi, RssiModel, load_rssi
from swiftwrf.rssi.coverage import Coverage
from swiftwrf.rssi.maps import RssiMap

RECEIVERS = np.array([(5.0, 10.0, 2.5), (10.0, 4.0, 2.5), (9.0, 16.0, 2.5)])


def write_hall(folder, known=False, n=150):
    """Write a walk of a hall of 40 x 20 m with access points in its west, and return the table and the RSSI."""
    folder.mkdir(parents=True)
    draw = np.random.default_rng(0)
    at = np.column_stack([draw.uniform(0, 40, n), draw.uniform(0, 20, n), np.full(n, 1.2)])
    mean = -40 - 30 * np.log10(np.linalg.norm(at[:, None] - RECEIVERS, axis=2))
    rssi = (mean + draw.normal(0, 3, mean.shape)).round(1)
    table = pd.DataFrame(at.round(2), columns=["x", "y", "z"]).assign(ap1=rssi[:, 0], ap2=rssi[:, 1], ap3=rssi[:, 2])
    table.to_csv(folder / "walk.csv", index=False)
    if known:
        names = pd.DataFrame(RECEIVERS, columns=["x", "y", "z"])
        names.insert(0, "receiver", ["ap1", "ap2", "ap3"])
        names.to_csv(folder / "receivers.csv", index=False)
    return folder / "walk.csv", rssi


def test_unknown_receivers_are_in_report_metrics_and_table_and_can_be_given_back(tmp_path, capsys):
    table, _ = write_hall(tmp_path / "walk")
    assert quick.run("rssi", "--rx", "all", "--data", table, "--out", tmp_path / "run") == 0
    said = capsys.readouterr().out
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    found = metrics["receiver_positions"]
    assert [one["receiver"] for one in found] == ["ap1", "ap2", "ap3"]
    for one, true in zip(found, RECEIVERS, strict=True):
        assert np.hypot(*(np.array(one["position_m"]) - true)[:2]) < 3
    radius = float(np.median([one["radius_80_m"] for one in found]))
    assert f"within {radius:.1f} m with 80 % probability" in said
    report = (tmp_path / "run" / "report.html").read_text()
    assert "Where the receivers are" in report
    given = pd.read_csv(tmp_path / "run" / "receivers.csv")
    np.testing.assert_allclose(given[["x", "y"]], [one["position_m"][:2] for one in found], atol=1e-3)
    (table.parent / "receivers.csv").write_bytes((tmp_path / "run" / "receivers.csv").read_bytes())
    np.testing.assert_allclose(load_rssi(table).receiver_position[:, :2], given[["x", "y"]], atol=1e-3)


def test_a_run_of_locate_has_them_too(tmp_path):
    table, _ = write_hall(tmp_path / "walk", n=80)
    assert quick.run("locate", "--data", table, "--cells", 200, "--out", tmp_path / "run") == 0
    assert (tmp_path / "run" / "receivers.csv").is_file()
    assert "Where the receivers are" in (tmp_path / "run" / "report.html").read_text()


def test_known_receivers_are_not_estimated(tmp_path):
    table, _ = write_hall(tmp_path / "walk", known=True, n=60)
    assert quick.run("rssi", "--rx", "all", "--data", table, "--out", tmp_path / "run") == 0
    assert not (tmp_path / "run" / "receivers.csv").exists()
    assert "receiver_positions" not in json.loads((tmp_path / "run" / "metrics.json").read_text())


def rough_hall(n=120):
    """Return a walk of a hall whose RSSI varies over metres, so that a scan determines its surroundings."""
    draw = np.random.default_rng(1)
    at = np.column_stack([draw.uniform(0, 40, n), draw.uniform(0, 20, n), np.full(n, 1.2)])
    at = at[~((at[:, 0] > 18) & (at[:, 0] < 30) & (at[:, 1] > 5) & (at[:, 1] < 15))]  # nobody walked there
    apart = np.linalg.norm(at[:, None] - at, axis=2)
    field = np.linalg.cholesky(64 * np.exp(-apart / 8) + 0.1 * np.eye(len(at))) @ draw.normal(size=len(at))
    return Rssi((-70 + field + draw.normal(0, 1, len(at)))[:, None], at, receiver_names=["ap1"])


def test_the_first_suggestion_is_the_best_of_all_cells():
    """The posterior variance after a scan in each cell of the walked area is computed in plain NumPy."""
    survey = rough_hall()
    model = RssiModel().fit(survey)
    found = suggest_scans(model, survey, 3, above_dbm=-70.0)
    kernel, known = model.kernel, survey.transmitter_position.numpy()
    extent = np.ptp(known[:, :2], axis=0)
    chart = RssiMap.predict(
        model, float(np.sqrt(extent.prod() / 1500)), None, survey.transmitter_position, detected=True
    )
    coverage = Coverage.of(chart, survey, (-70.0, 0.9, 1))
    x, y = np.meshgrid(chart.x, chart.y)
    cell = np.column_stack([x[coverage.inside], y[coverage.inside], np.full(coverage.inside.sum(), chart.height)])
    weight = (coverage.probability * (1 - coverage.probability))[coverage.inside]

    def covariance(a, b):
        return kernel(torch.tensor(a), torch.tensor(b)).numpy()

    inverse = np.linalg.inv(covariance(known, known) + kernel.noise * np.eye(len(known)))
    posterior = covariance(cell, cell) - covariance(cell, known) @ inverse @ covariance(known, cell)
    fall = [weight @ posterior[:, i] ** 2 / (posterior[i, i] + kernel.noise) for i in range(len(cell))]
    np.testing.assert_allclose(found.position[0], cell[int(np.argmax(fall))], atol=1e-6)
    ratio = 1 - max(fall) / (weight @ posterior.diagonal())
    assert abs(float(found.variance[1] / found.variance[0]) - ratio) < 1e-4


def test_suggestions_are_printed_and_in_the_report(tmp_path, capsys):
    hall = rough_hall()
    table = pd.DataFrame(hall.transmitter_position.numpy(), columns=["x", "y", "z"]).assign(ap1=hall.rssi_dbm.numpy())
    table.to_csv(tmp_path / "walk.csv", index=False)
    options = ("--rx", "all", "--data", tmp_path / "walk.csv", "--suggest", 12)
    assert quick.command("rssi", *options, "--out", tmp_path / "run") == 0
    printed = capsys.readouterr().err
    suggested = pd.read_csv(tmp_path / "run" / "suggested.csv")
    rows = re.findall(r"^ +(\d+) +([\d.]+) +([\d.]+) +([\d.]+) +([\d.]+)%$", printed, flags=re.MULTILINE)
    assert [float(row[1]) for row in rows] == [round(x, 2) for x in suggested["x_m"][:10]]
    assert "rank   x [m]   y [m]   z [m]  variance left" in printed
    assert "Where to measure next" in (tmp_path / "run" / "report.html").read_text()


def test_no_position_is_suggested_where_the_coverage_is_known():
    survey = rough_hall()
    found = suggest_scans(RssiModel().fit(survey), survey, 3, above_dbm=-120.0)
    assert len(found.position) == 0
