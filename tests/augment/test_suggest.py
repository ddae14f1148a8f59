"""Suggested positions to measure next, for directions and for locating."""

import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import quick
import torch

from augment.suggest import suggest, suggest_positions
from swiftwrf import rssi_room
from swiftwrf.gp import most_informative
from swiftwrf.locate import RssiLocator
from tasks.page.shared import suggestion_section, write_suggestion


def test_suggestions_lie_in_the_region_and_lower_the_variance(room):
    found = suggest(room, 12)
    low, high = room.position.min(dim=0).values, room.position.max(dim=0).values
    assert ((found.position >= low) & (found.position <= high)).all()
    assert (found.variance.diff() < 0).all()
    assert torch.equal(found.position, suggest(room, 12).position)
    nearest = torch.cdist(found.position, room.position).min(dim=1).values
    apart = torch.cdist(room.position, room.position).kthvalue(2).values
    assert nearest.median() > apart.median() / 2  # not where it is known


def test_suggested_positions_keep_the_digits_of_maps(room, tmp_path):
    """Coordinates on a map have more digits than single precision."""
    measured = replace(room, position=room.position.double() + torch.tensor([712345.678, 5412345.678, 0]).double())
    found = suggest(measured, 3)
    write_suggestion(tmp_path / "suggested", measured.position, found.position, found.variance)
    table = pd.read_csv(tmp_path / "suggested.csv", float_precision="round_trip")
    assert table[["x_m", "y_m", "z_m"]].to_numpy().tolist() == found.position.tolist()
    assert table["variance_left"].tolist() == found.variance[1:].tolist()


@pytest.mark.parametrize(("left", "is_worth"), [((0.5, 0.48, 0.46), False), ((0.5, 0.46, 0.44), True)])
def test_the_report_states_the_variance_before_and_after(left, is_worth):
    arrays = {"measured": np.zeros((4, 3)), "suggested": np.arange(6.0).reshape(2, 3), "left": np.array(left)}
    section = suggestion_section("", arrays, "table", "run", what="a", whole="b", how="c", label="d")
    (text,), (plot,) = section.paragraphs, section.plots
    assert (
        f"at 2 more positions (table.csv, the most useful first) would reduce a from 50% to {left[2]:.0%} of b" in text
    )
    assert ("not worth it" not in text) == is_worth
    percent = [100 * value for value in left]
    assert plot.panels[1].axes[0].lines[0].get_xydata().tolist() == [list(pair) for pair in enumerate(percent)]
    assert plot.data["variance_left"].tolist() == list(left[1:])


@pytest.fixture(scope="module")
def located():
    train = rssi_room(n=60)
    return RssiLocator(n_cells=300).fit(train), train


def test_suggested_cells_lower_the_variance(located):
    locator, train = located
    found = suggest_positions(locator, train, 6, seed=2)
    assert torch.cdist(found.position, locator.cells.position).amin(dim=1).max() < 1e-6
    assert len(found.position.unique(dim=0)) == 6
    assert (found.variance.diff() <= 0).all()
    assert found.position.equal(suggest_positions(locator, train, 6, seed=2).position)


def test_positions_are_suggested_where_errors_are_large(located, monkeypatch):
    locator, train = located
    middle = locator.cells.position[:, 0].mean()

    def errors(locator, position, generator):
        return 0.01 + 10.0 * (position[:, 0] > middle)

    monkeypatch.setattr(sys.modules["augment.suggest"], "_expected_errors", errors)
    assert (suggest_positions(locator, train, 5).position[:, 0] > middle - 1).all()


def test_weights_are_those_of_the_definition(located):
    locator, train = located
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


def test_suggestions_of_a_run(tmp_path):
    assert quick.run("locate", "--cells", 200, "--suggest", 4, "--out", tmp_path / "run") == 0
    table = pd.read_csv(tmp_path / "run" / "suggested.csv")
    assert list(table.columns) == ["x_m", "y_m", "z_m", "variance_left"]
    assert len(table) == 4
    assert "Where to measure next" in (tmp_path / "run" / "report.html").read_text()
