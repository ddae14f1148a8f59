"""Studies can be stopped at any time, state what measured their rows, and compare predictors on the same pairs."""

import json
from argparse import Namespace
from contextlib import nullcontext
from pathlib import Path

import fields
import numpy as np
import pytest
import record
import rssi
import rssi_tables
import torch

from swiftwrf import AngularGrid, rssi_room, simulated_room
from swiftwrf.rssi.head import Head, Heads

METHODS = ("mean", "nearest", "swiftwrf", "vae")


@pytest.fixture
def study(tmp_path, monkeypatch, small_published):
    """The comparison of few methods on a small room, and what it writes."""
    data = simulated_room(n=30, grid=AngularGrid.hemisphere(8, 32))
    written = []
    monkeypatch.setattr(fields, "scenes", lambda config: [("room", data, "random")])
    monkeypatch.setattr(fields, "COMPARED", METHODS)
    monkeypatch.setattr(record, "RESULTS", tmp_path)
    monkeypatch.setitem(fields.QUICK_DIVISOR, "comparison", 1)
    monkeypatch.setattr(fields, "write_result", lambda name, content: written.append((name, content)))
    return written


def test_a_study_goes_on_after_the_rows_that_are_there(study, tmp_path, monkeypatch):
    config = fields.Config("comparison", quick=True, parts=("scenes",), work=tmp_path)
    honest, measured = fields.measure, []

    def measure(part, fit, state):
        if len(measured) == 2:
            raise KeyboardInterrupt
        measured.append(fit.method)
        return honest(part, fit, state)

    monkeypatch.setattr(fields, "measure", measure)
    with pytest.raises(KeyboardInterrupt):
        fields.main(config)
    before = list(measured)
    measured.clear()
    fields.main(config)
    assert tuple(before + measured) == METHODS
    ((name, content),) = study
    assert name == "comparison_quick"
    rows = {row["method"]: row for row in content["rows"]}
    assert tuple(rows) == METHODS
    assert rows["vae"]["steps"] > 0
    assert rows["nearest"]["parameters"] == 24 * 8 * 32
    for row in rows.values():
        assert row["ms"]["low"] <= row["ms"]["median"]
        assert (row["n_train"], row["n_test"]) == (24, 6)
        assert {"command", "commit", "date", "versions", "machine"} == set(row["provenance"])
    assert not list(tmp_path.rglob("*.state"))


def test_rows_measured_at_different_times_have_a_provenance_each(tmp_path, monkeypatch):
    monkeypatch.setattr(record, "RESULTS", tmp_path)
    for number, command in enumerate(("first.py", "folder/second.py --n 2")):
        monkeypatch.setattr(record.sys, "argv", command.split())
        new = {"n": number}
        record.write_result("made", {"rows": [*record.kept("made", "rows"), new]}, folder=tmp_path, rows=[new])
    measured = [row["provenance"] for row in json.loads((tmp_path / "made.json").read_text())["rows"]]
    assert [row["command"] for row in measured] == ["python first.py", "python second.py --n 2"]
    assert all(set(row) == {"command", "commit", "date", "versions", "machine"} for row in measured)


def test_the_age_of_a_table_is_that_of_its_oldest_and_newest_row(tmp_path, monkeypatch):
    monkeypatch.setattr(record, "RESULTS", tmp_path)

    def measured(day: int, commit: str) -> dict[str, object]:
        start, packages = f"2026-01-{day:02d}T00:00:00+00:00", {"swiftwrf-tasks": "0.3.0"}
        return {"commit": commit, "start": start, "packages": packages, "device": "CPU"}

    old = record._provenance("python x.py", measured(2, "b"))
    content = {"command": "python x.py", "environment": measured(9, "a")}
    (tmp_path / "rows.json").write_text(json.dumps(content | {"rows": [{"provenance": old}, {"n": [1]}]}))
    (tmp_path / "whole.json").write_text(json.dumps(content | {"rows": [{"n": 1}]}))
    assert record.age(["rows"]) == "Measured on 2026-01-02 (version 0.3.0, commit b)."
    assert record.age(["whole", "rows"]) == (
        "Measured from 2026-01-02 (version 0.3.0, commit b) to 2026-01-09 (version 0.3.0, commit a)."
    )


def test_uncommitted_code_is_not_measured(monkeypatch):
    monkeypatch.setattr(record.tyro, "cli", lambda config_type: config_type())
    for changed in ("", " M swiftwrf/gp/kernel.py\n"):
        monkeypatch.setattr(record.subprocess, "run", lambda *_, changed=changed, **options: Namespace(stdout=changed))
        with pytest.raises(SystemExit, match=r"commit them:\n M swiftwrf/gp") if changed else nullcontext():
            assert record.options(dict) == {}


@pytest.fixture
def results(monkeypatch):
    written = []
    data = rssi_room(n=60).columns([0, 1])
    monkeypatch.setattr(rssi, "SPLITS", {"a": ("random", "block"), "b": ("random",)})
    monkeypatch.setattr(rssi, "load_rssi", lambda path, transmitter: data)
    monkeypatch.setattr(rssi, "kept", lambda name, key: {})
    monkeypatch.setattr(rssi, "write_result", lambda name, content, rows: written.append(content["sets"]))
    return written


def test_every_predictor_has_the_same_pairs_and_a_difference_to_the_best_baseline(results, monkeypatch):
    rssi.main(rssi.Config(data=Path(), sets=("b",)))
    found = results[-1]["b random"]
    methods, best = found["methods"], found["best_baseline"]
    assert best not in rssi.OWN
    assert {"swiftwrf", "identity", "gp", "knn"} <= set(methods)
    assert len({entry["abs_error_db"]["n"] for entry in methods.values()}) == 1
    assert methods[best]["difference_db"]["median"] == methods[best]["difference_db"]["mean"] == 0
    assert 0.5 < methods["swiftwrf"]["coverage"] <= 1
    monkeypatch.setattr(rssi_tables, "load", lambda name: {"sets": results[-1]})
    assert "| b random |" in rssi_tables.rssi_glance()


def test_measured_splits_are_skipped_on_resume(results, monkeypatch):
    kept = {"a random": {"methods": {}}, "b random": {"methods": {}}}
    monkeypatch.setattr(rssi, "kept", lambda name, key: kept)
    monkeypatch.setattr(rssi, "measure", lambda data, split, also: {"methods": {}, "split": split})
    rssi.main(rssi.Config(data=Path(), resume=True))
    assert [list(sets) for sets in results] == [["a random", "a block", "b random"]]
    assert "split" not in results[-1]["b random"]


def test_scans_are_counted_where_coverage_is_predicted(monkeypatch):
    """A made model whose probabilities are known: 0.95 at the rows of even number, else 0.05."""
    data, written = rssi_room(n=60), []
    monkeypatch.setattr(rssi, "COVERAGE", {"simulated-floor-3": ("random",)})
    monkeypatch.setattr(rssi, "kept", lambda name, key: {})
    monkeypatch.setattr(rssi, "rssi_room", lambda seed: data)
    monkeypatch.setattr(rssi, "write_result", lambda name, content, rows: written.append((name, content["scenes"])))
    monkeypatch.setattr(
        rssi, "predicted_above", lambda model, scans, *_, **__: 0.05 + 0.9 * (scans.index % 2 == 0).double()
    )
    rssi.main(rssi.Config(data=Path(), study="coverage", receivers=4))
    ((name, scenes),) = written
    found, (train, test) = scenes["simulated-floor-3 random"], data.split()
    assert (name, found["n_receivers"]) == ("coverage_headline", 4)
    often = np.sort(np.argsort(-data.detected.sum(dim=0).numpy(), kind="stable")[:4])
    strongest, is_even = (np.nanmax(test.rssi_dbm.numpy()[:, often], axis=1), test.index.numpy() % 2 == 0)
    known = np.nanmax(train.rssi_dbm.numpy()[:, often], axis=1)
    for row, quantile in zip(found["rows"][1:], rssi.QUANTILES, strict=True):
        assert row["threshold_dbm"] == np.floor(np.quantile(known, quantile)) + 0.5
        above = strongest > row["threshold_dbm"]
        expected = {"predicted": np.where(is_even, 0.95, 0.05).mean(), "above": above.mean(), "certain": is_even.mean()}
        expected |= {"n": len(test), "n_certain": is_even.sum(), "certain_above": above[is_even].mean()}
        assert {name: row[name] for name in expected} == pytest.approx(expected)
    assert found["brier_by_correlation"].keys() == {str(value) for value in rssi.CORRELATIONS}


def test_primitives_in_phase_are_the_identity():
    latent = torch.linspace(-60, 60, 25)[:, None].double()
    table = Heads(rssi.in_phase([Head(50, 0).requires_grad_(False)]))
    value, _ = table(latent)
    torch.testing.assert_close(value - table(0 * latent)[0], latent, atol=1e-3, rtol=0)
    assert not rssi.in_phase([Head(0, 0)]).any()
