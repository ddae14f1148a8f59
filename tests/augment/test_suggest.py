"""Suggested positions to measure next."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from augment.suggest import suggest
from augment.turbo.choice import Suggestion
from augment.turbo.condition import MeasuredSubset
from swiftwrf import AngularGrid, InputError, make_model, simulated_room
from swiftwrf.data.splits import folds
from swiftwrf.gp import choose_kernel, most_informative
from swiftwrf.metrics import psnr
from tasks.aoa.experiment import _write_files
from tasks.records import read_table


def test_suggestions_lie_in_the_region_and_lower_the_variance(room):
    found = suggest(room, 12)
    low, high = room.position.min(dim=0).values, room.position.max(dim=0).values
    assert ((found.position >= low) & (found.position <= high)).all()
    assert (found.variance.diff() < 0).all()
    assert torch.equal(found.position, suggest(room, 12).position)
    nearest = torch.cdist(found.position, room.position).min(dim=1).values
    assert (
        nearest.median() > torch.cdist(*2 * (room.position,)).kthvalue(2).values.median() / 2
    )  # not where it is known


def test_suggested_positions_keep_the_digits_of_maps(room, tmp_path):
    """Coordinates on a map have more digits than single precision."""
    measured = replace(room, position=room.position.double() + torch.tensor([712345.678, 5412345.678, 0]).double())
    found, directory = suggest(measured, 3), SimpleNamespace(path=tmp_path.joinpath)
    positions = {"measured": measured.position.tolist(), "position": found.position.tolist()}
    value = positions | {"variance": found.variance.tolist()}
    _write_files(Suggestion(MeasuredSubset(0.5)), value, measured, directory)
    table = read_table(tmp_path / "suggested-mix0.5.csv")
    assert table[["x_m", "y_m", "z_m"]].to_numpy() == pytest.approx(found.position.numpy(), rel=1e-12)


def test_measuring_at_suggested_positions_beats_random_ones():
    """In the built-in room: 40 spectra are known, 40 more are measured, and the model draws the others."""
    pool = simulated_room(n=500, grid=AngularGrid.hemisphere(15, 60))
    known, rest = torch.arange(40), torch.arange(40, 500)
    first = pool.subset(known)
    kernel = choose_kernel(first.position, first.spectrum, folds(first.position, "random", 0))

    def quality(more):
        """Mean PSNR of the model at the positions that stay unmeasured."""
        model = make_model("gp").fit(pool.subset(torch.cat([known, rest[more]])))
        left = pool.subset(rest[[i for i in range(len(rest)) if i not in set(more.tolist())]])
        return float(psnr(model.synthesize(left.position), left.spectrum).mean())

    suggested, _ = most_informative(kernel, first.position, pool.position[rest], 40)
    generator = torch.Generator().manual_seed(0)
    random = [quality(torch.randperm(len(rest), generator=generator)[:40]) for _ in range(4)]
    assert quality(suggested) > max(random)


@pytest.mark.parametrize("count", [0, -1, 501])
def test_refuses_other_counts(room, count):
    with pytest.raises(InputError, match="between 1 and 500"):
        suggest(room, count)
