"""Suggested positions to measure next for locating."""

from __future__ import annotations

import sys

import pandas as pd
import pytest
import quick
import torch
from quick import said

from augment.suggest import suggest_positions
from swiftwrf import InputError, rssi_room
from swiftwrf.gp import most_informative
from swiftwrf.locate import RssiLocator


@pytest.fixture(scope="module")
def fitted():
    train = rssi_room(n=60)
    return RssiLocator(n_cells=300).fit(train), train


def test_suggested_cells_lower_the_variance(fitted):
    locator, train = fitted
    found = suggest_positions(locator, train, 6, seed=2)
    assert torch.cdist(found.position, locator.cells.position).amin(dim=1).max() < 1e-6
    assert len(found.position.unique(dim=0)) == 6
    assert (found.variance.diff() <= 0).all()
    assert found.position.equal(suggest_positions(locator, train, 6, seed=2).position)


def test_positions_are_suggested_where_errors_are_large(fitted, monkeypatch):
    locator, train = fitted
    middle = locator.cells.position[:, 0].mean()

    def errors(locator, position, generator):
        return 0.01 + 10.0 * (position[:, 0] > middle)

    monkeypatch.setattr(sys.modules["augment.suggest"], "_expected_errors", errors)
    assert (suggest_positions(locator, train, 5).position[:, 0] > middle - 1).all()


def test_weights_are_those_of_the_definition(fitted):
    locator, train = fitted
    kernel, known, candidate = locator.model.kernel, train.transmitter_position, locator.cells.position[:40]
    weight = torch.rand(40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    chosen, left = most_informative(kernel, known, candidate, 1, weight)

    def mean(known):
        cross = kernel(candidate, known)
        return (
            weight @ (1 - (cross * torch.linalg.solve(kernel.covariance(known), cross.T).T).sum(dim=1)) / weight.sum()
        )

    after = torch.stack([mean(torch.cat([known, one[None]])) for one in candidate])
    assert left[0].allclose(mean(known), atol=1e-6)
    assert left[1].allclose(after.min(), atol=1e-4)
    assert after[chosen[0]].allclose(after.min(), atol=1e-4)


def test_other_numbers_are_refused(fitted):
    locator, train = fitted
    with pytest.raises(InputError, match="between 1 and 500"):
        suggest_positions(locator, train, 0)
    with pytest.raises(InputError, match="more cells"):
        suggest_positions(RssiLocator(n_cells=50).fit(train), train, 500)
    with pytest.raises(InputError, match="other receivers"):
        suggest_positions(locator, train.columns([0, 1]), 3)


def test_suggestions_of_a_run(tmp_path, capsys):
    assert quick.run("locate", "--cells", 200, "--suggest", 4, "--out", tmp_path / "run") == 0
    table = pd.read_csv(tmp_path / "run" / "suggested.csv")
    assert list(table.columns) == ["x_m", "y_m", "z_m", "variance_left"]
    assert len(table) == 4
    assert "Where to measure next" in (tmp_path / "run" / "report.html").read_text()
    capsys.readouterr()
    assert quick.run("locate", "--suggest", 501) == 2
    assert "--suggest must be a whole number at least 0 and at most 500" in said(capsys)
