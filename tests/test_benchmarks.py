"""The comparison of all methods can be stopped at any time, and added to."""

from __future__ import annotations

from pathlib import Path

import comparison
import pytest

from swiftwrf import AngularGrid, simulated_room


def test_the_comparison_goes_on_after_the_rows_that_are_there(tmp_path, monkeypatch, small_published):
    data = simulated_room(n=30, grid=AngularGrid.hemisphere(8, 32))
    written = []
    monkeypatch.setattr(comparison, "scenes", lambda config: [("room random", data, "random")])
    monkeypatch.setattr(comparison, "QUICK_DIVISOR", 1)
    monkeypatch.setattr(comparison, "write_result", lambda name, content: written.append((name, content)))
    config = comparison.Config(data=Path(), quick=True, work=tmp_path)
    honest, measured = comparison.row, []

    def row(method, *others):
        if len(measured) == 6:
            raise KeyboardInterrupt
        measured.append(method)
        return honest(method, *others)

    monkeypatch.setattr(comparison, "row", row)
    with pytest.raises(KeyboardInterrupt):
        comparison.main(config)
    before = list(measured)
    measured.clear()
    comparison.main(config)
    methods = [*comparison.BASELINES, *comparison.LEARNT]
    assert before + measured == methods
    ((name, content),) = written
    assert name == "comparison_quick"
    rows = content["scenes"]["room random"]["24"]
    assert list(rows) == methods
    assert rows["nerf2"]["parameters"] < rows["nearest"]["parameters"] == 24 * 8 * 32
    assert all(row["ms"]["low"] <= row["ms"]["median"] and row["n_test"] == 6 for row in rows.values())
    assert not list(tmp_path.rglob("*.state"))


def test_a_scene_is_added_to_the_committed_comparison(tmp_path):
    earlier = {"room random": {"24": {"gp": {"ms": 1}, "mean": {"ms": 2}}, "80": {"gp": {"ms": 3}}}}
    for name, ms in (("room random 24 gp", 4), ("attic random 9 swiftwrf", 5), ("attic random 9 mean", 6)):
        (tmp_path / f"{name}.json").write_text(f'{{"ms": {ms}}}')
    found = comparison.gathered(tmp_path, earlier)
    assert list(found) == ["attic random", "room random"]
    assert list(found["attic random"]["9"]) == ["mean", "swiftwrf"]
    assert list(found["room random"]) == ["80", "24"]
    assert found["room random"]["24"] == {"mean": {"ms": 2}, "gp": {"ms": 4}}
    assert earlier["room random"]["24"]["gp"] == {"ms": 1}
