"""Studies can be stopped at any time and state what measured their rows."""

from __future__ import annotations

import json
from argparse import Namespace
from contextlib import nullcontext

import fields
import pytest
import record

from swiftwrf import AngularGrid, simulated_room

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
        assert {"command", "commit", "versions", "machine"} == set(row["provenance"])
    assert not list(tmp_path.rglob("*.state"))


def test_rows_measured_at_different_times_have_a_provenance_each(tmp_path, monkeypatch):
    monkeypatch.setattr(record, "RESULTS", tmp_path)
    for number, command in enumerate(("first.py", "folder/second.py --n 2")):
        monkeypatch.setattr(record.sys, "argv", command.split())
        new = {"n": number}
        record.write_result("made", {"rows": [*record.kept("made", "rows"), new]}, folder=tmp_path, rows=[new])
    measured = [row["provenance"] for row in json.loads((tmp_path / "made.json").read_text())["rows"]]
    assert [row["command"] for row in measured] == ["python first.py", "python second.py --n 2"]
    assert all(set(row) == {"command", "commit", "versions", "machine"} for row in measured)


def test_uncommitted_code_is_not_measured(monkeypatch):
    monkeypatch.setattr(record.tyro, "cli", lambda config_type: config_type())
    for changed in ("", " M swiftwrf/gp/kernel.py\n"):
        monkeypatch.setattr(record.subprocess, "run", lambda *_, changed=changed, **options: Namespace(stdout=changed))
        with pytest.raises(SystemExit, match=r"commit them:\n M swiftwrf/gp") if changed else nullcontext():
            assert record.options(dict) == {}
