"""The benchmark of measured RSSI: the same pairs for all predictors, resumable, its tables."""

from __future__ import annotations

from pathlib import Path

import pytest
import rssi
import rssi_tables
import torch

from swiftwrf import rssi_room
from swiftwrf.rssi.head import Head, HeadTable


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


def test_primitives_in_phase_are_the_identity():
    latent = torch.linspace(-60, 60, 25)[:, None].double()
    table = HeadTable(rssi.in_phase([Head("a", 50, 0).requires_grad_(False)]))
    value, _ = table(latent)
    torch.testing.assert_close(value - table(0 * latent)[0], latent, atol=1e-3, rtol=0)
    assert not rssi.in_phase([Head("a", 0, 0)]).any()
