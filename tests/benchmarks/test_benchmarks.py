"""The comparison of all methods can be stopped at any time; networks are compared on held-out spectra."""

from __future__ import annotations

from pathlib import Path

import comparison
import networks
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


def test_the_comparison_gathers_rows_in_the_order_of_scenes_and_methods(tmp_path):
    rows = {"room random 24 gp": 1, "room random 24 mean": 2, "room random 80 gp": 3, "attic random 9 swiftwrf": 4}
    for name, ms in rows.items():
        (tmp_path / f"{name}.json").write_text(f'{{"ms": {ms}}}')
    found = comparison.gathered(tmp_path)
    assert list(found) == ["attic random", "room random"]
    assert list(found["room random"]) == ["80", "24"]
    assert list(found["room random"]["24"].items()) == [("mean", {"ms": 2}), ("gp", {"ms": 1})]


def test_networks_are_compared_on_training_spectra_that_are_held_out(monkeypatch):
    room, written = simulated_room(n=60, grid=AngularGrid.hemisphere(8, 32)), []
    held_out = room.split("random")[0].split("random", seed=1)[1]
    monkeypatch.setattr(networks, "simulated_room", lambda: room)
    monkeypatch.setattr(networks, "has_room", lambda data: False)
    monkeypatch.setattr(networks, "write_result", lambda name, content: written.append(content))
    networks.main(networks.Config(trainings=("measured", "turbo"), steps=(1,), name="none"))
    rows = written[-1]["scenes"]["room"]
    assert [entry["n_train"] for entry in rows.values()] == [11, 38]
    for entry in rows.values():
        heads = {f"{name}, quick, 1 steps" for name in ("aann", "aann_kernel")}
        assert set(entry["methods"]) == {"kernel_regression", "nearest_spectrum", *heads}
        assert entry["methods"]["kernel_regression"]["change"]["change"] == 0
        assert all(len(method["errors_deg"]) == len(held_out) == 10 for method in entry["methods"].values())
