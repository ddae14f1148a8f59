"""Runs of latency, of which less is better, as a user runs them: every number against counted rows and plain NumPy."""

import io
import json

import numpy as np
import pandas as pd
import pytest
import quick
import torch
from scipy.stats import norm

from swiftwrf import load
from tasks.view.rssi import MapSelection
from tasks.view.sources import open_source

DRAW = np.random.default_rng(0)
AT = DRAW.uniform(0, 20, (160, 2))
GATEWAYS = ("east", "west")
TRUTH = 40 + 25 * np.stack([np.sin(AT[:, 0] / 5), np.cos(AT[:, 1] / 6)], axis=1)  # [ms]
MEASURED = TRUTH + DRAW.normal(0, 3, (160, 2))


def write(file, rows):
    """A row for each gateway, and how to read the table."""
    tables = [
        pd.DataFrame(AT[rows], columns=["x", "y"]).assign(gateway=name, latency_ms=MEASURED[rows, number])
        for number, name in enumerate(GATEWAYS)
    ]
    pd.concat(tables).sort_index(kind="stable").to_csv(file, index=False)
    file.with_name(f"{file.name}.reading.yaml").write_text("quantity: latency\nunit: ms\ncolumns: receiver=gateway\n")
    return file


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("latency")
    table = write(folder / "lat.csv", np.arange(120))
    assert quick.run("rssi", "--data", table, "--below", 50, 35, "--out", folder / "run") == 0
    return folder / "run"


def test_the_share_below_the_threshold_is_counted(run):
    table, errors = pd.read_csv(run / "coverage.csv"), pd.read_csv(run / "errors.csv")
    assert set(table["direction"]) == {"below"}
    assert not [name for name in (*table, *errors) if name.endswith(("_db", "_dbm", "_above"))]
    test = np.unique(errors["index"])
    train, model = np.setdiff1d(np.arange(120), test), load(run / "model.safetensors")
    found = model.predict(np.column_stack([AT[test], np.zeros(len(test))]))
    for threshold in (50.0, 35.0):
        rows = table[table["threshold_ms"] == threshold].set_index("receiver")
        below = threshold > MEASURED
        for name, passed in (("any receiver", below.any(axis=1)), ("two receivers", below.all(axis=1))):
            assert rows.loc[name, "scans_below"] == pytest.approx(passed[train].mean(), abs=1e-9)
            assert rows.loc[name, "test_below"] == pytest.approx(passed[test].mean(), abs=1e-9)
        for number, name in enumerate(GATEWAYS):
            expected = norm.cdf((threshold - found.mean[:, number]) / found.std[:, number]).mean()
            assert rows.loc[name, "test_predicted"] == pytest.approx(expected, abs=2e-3)
            assert rows.loc[name, "test_below"] == pytest.approx(below[test, number].mean(), abs=1e-9)


def test_the_map_of_the_best_gateway_is_that_of_the_lowest_latency(run):
    cells, maps = pd.read_csv(run / "figures" / "summary.csv"), dict(np.load(run / "maps.npz"))
    np.testing.assert_allclose(cells["predicted_ms"], maps["predicted"][0].min(axis=0).ravel(), atol=0.01)
    spots = pd.read_csv(run / "weak_spots.csv")
    spot, margin = spots[spots["threshold_ms"] == 35].iloc[0], norm.ppf(0.9)
    at = torch.tensor([[spot["x_m"], spot["y_m"], 0.0]], dtype=torch.float64)
    found = load(run / "model.safetensors").predict(at)
    needed = (found.mean + margin * found.std - 35).min()
    assert spot["missing_ms"] == pytest.approx(float(needed), abs=0.1)


def test_answer_and_report_have_the_unit_and_the_direction(run, tmp_path, capsys):
    assert quick.run("rssi", "--data", run.parent / "lat.csv", "--json", "--out", tmp_path / "default") == 0
    answer = json.loads(capsys.readouterr().out)
    text = answer["conclusion"]
    train = np.setdiff1d(np.arange(120), pd.read_csv(tmp_path / "default" / "errors.csv")["index"])
    assert f"below {float(f'{np.median(MEASURED[train]):.3g}'):g} ms" in text
    assert "too high at" in text
    page = (run / "report.html").read_text()
    assert "below 50 ms" in page
    for words in ("dBm", "position of one receiver", "packets are lost", "Where the receivers are"):
        assert words not in text + page[: page.index("Provenance")]
    assert quick.run("report", run, tmp_path / "default", "--out", tmp_path / "both") == 0


def test_the_page_shows_the_quantity(run):
    view, selection = open_source(run), MapSelection("coverage", 1, 0.0, 50.0)
    assert (view.threshold, view.unit, view.direction) == (50.0, "ms", "below")
    assert view.coloured(selection).sentence.count("(west below 50 ms with at least 90% probability)") == 1
    found = view.model.predict(np.array([[5.0, 5.0, 0.0]]))
    best = GATEWAYS[int(found.mean[0].argmin())]
    assert f"best receiver: {best}, {found.mean[0].min():.1f} ms" in view.describe(selection, 5.0, 5.0)
    chance = norm.cdf((50 - found.mean[0, 1]) / found.std[0, 1])
    assert f"west below 50 ms with {chance:.0%}" in view.describe(selection, 5.0, 5.0)
    assert {"predicted_ms", "low_ms", "high_ms", "below_50_ms_with_90%"} <= {
        *pd.read_csv(io.StringIO(view.table(selection)))
    }
    low, high, _ = view.limits
    assert low < 35 < 50 < high
    assert open_source(run / "model.safetensors").direction == "below"


def test_an_update_states_its_errors_in_the_unit(run, tmp_path, capsys):
    new = write(tmp_path / "new.csv", np.arange(120, 160))
    assert quick.run("update", run / "model.safetensors", new, "--out", tmp_path / "updated") == 0
    assert " ms, over the last " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("plan", "RUN"), "is a run of latency; a plan needs a run of RSSI"),
        (("rssi", "--data", "TABLE", "--below", 50, "--above", 50), "--above and --below exclude each other"),
        (("rssi", "--below", -70), "below is for another quantity than RSSI"),
        (("locate", "--data", "TABLE"), "has latency, but a locator needs RSSI"),
    ],
)
def test_what_needs_power_is_refused(run, tmp_path, capsys, words, message):
    paths = {"RUN": run, "TABLE": run.parent / "lat.csv"}
    assert quick.run(*(paths.get(word, word) for word in words), "--out", tmp_path / "out") == 2
    assert message in capsys.readouterr().err
    assert not [*tmp_path.glob("out*")]
