"""Fitting by regression: what it reaches and what it refuses; standard deviations of all models that predict them."""

from dataclasses import replace

import pytest
import torch

from swiftwrf import AngularGrid, SwiftWRF, fit, make_model, simulated_room
from swiftwrf.data.splits import folds
from swiftwrf.data.store import Store
from swiftwrf.gp import GaussianProcess, choose_kernel
from swiftwrf.metrics import covered, psnr
from swiftwrf.models.swiftwrf import smallest


def test_finds_a_size(room):
    """The chosen size is among the candidates, and predicts held-out spectra as well as any."""
    records = []
    model = SwiftWRF().fit(room, on_record=records.append)
    tried = {r["n_primitives"]: r["validation"] for r in records if r["stage"] == "search"}
    n = records[-1]["n_primitives"]
    assert records[-1]["stage"] == "final"
    assert len(model.mean) == n
    assert tried[n] <= 1.004 * min(tried.values())
    assert all(tried[smaller] > 1.004 * min(tried.values()) for smaller in tried if smaller < n)


@pytest.mark.parametrize(
    ("losses", "found", "tried"),
    [
        ([8, 4, 2, 1, 0.5], 160, 5),  # the more the better: the largest
        ([8, 4, 2, 2.1, 0.1], 40, 4),  # a size without gain ends the search
        ([8, 4, 3.998, 2], 20, 3),  # a difference of less than 0.4 % does not count
        ([3, 3, 3], 10, 2),  # nothing helps: the smallest
        ([0, 0, 0], 10, 2),  # constant spectra, whose losses round to 0 or below
        ([-1e-9, 0, 0], 10, 2),
        ([0, -1e-9, 0], 20, 3),
    ],
)
def test_the_smallest_size_that_does_as_well_as_any_is_found(losses, found, tried):
    asked = []

    def loss(size):
        asked.append(size)
        return losses[len(asked) - 1]

    assert smallest(loss, tuple(10 * 2**i for i in range(len(losses)))) == found
    assert asked == [10 * 2**i for i in range(tried)]


@pytest.mark.parametrize("level", [0.0, 0.5])
def test_constant_spectra_are_predicted(room, short_fits, level):
    still = replace(room, store=Store(torch.full_like(room.spectrum, level)))
    found = fit(still).update(still).predict(room.position)
    torch.testing.assert_close(found.mean, still.spectrum, atol=2e-2, rtol=0)
    assert (found.std > 0).all()


def test_regression_draws_what_the_process_on_the_pixels_predicts(room):
    """With enough primitives to draw any spectrum of the room, and all that is measured known."""
    unseen = room.subset(torch.arange(0, 40, 4))
    known = room.subset(torch.tensor([i for i in range(40) if i % 4]))
    model = fit(known, n_primitives=256, max_azimuths=0)
    kernel = choose_kernel(known.position, known.spectrum, folds(known.position, "random", 0))
    mean = known.spectrum.mean(dim=0)
    change = (known.spectrum - mean).flatten(1)
    process = GaussianProcess(kernel, known.position, change)
    predicted = (mean + process.mean(unseen.position).reshape(unseen.spectrum.shape)).clamp(0, 1)
    assert psnr(model.synthesize(unseen.position), predicted).min() > 38


@pytest.mark.parametrize("name", ["swiftwrf", "gp", "coarray", "hybrid"])
def test_standard_deviations_are_calibrated(built_in_room, floor_alone, name):
    """75 to 85 % of the pixels of unseen spectra lie within 1.28 standard deviations; these grow with the distance."""
    train, test = built_in_room
    model = make_model(name).fit(train)
    found = model.predict(test.position)
    assert 0.75 < covered(found.mean, found.std, test.spectrum).mean() < 0.85
    near, far = (model.predict(position).std for position in (train.position, test.position + 100))
    assert near.mean() < found.std.mean() < far.mean()


def test_standard_deviations_hold_where_positions_repeat():
    """The other measurements of its place predict one almost exactly, so a place is held out as a whole."""
    grid = AngularGrid.hemisphere(8, 32)
    position = simulated_room(n=50, seed=1, grid=grid).position.repeat(4, 1)
    train = simulated_room(n=len(position), seed=2, grid=grid, position=position, phase_noise=0.3)
    test = simulated_room(n=150, seed=9, grid=grid, phase_noise=0.3)
    found = SwiftWRF(n_primitives=32).fit(train).predict(test.position)
    assert 0.72 < covered(found.mean, found.std, test.spectrum).mean() < 0.88


@pytest.mark.parametrize("name", ["swiftwrf", "gp", "coarray"])
def test_standard_deviations_follow_updates_and_another_kernel(built_in_room, name):
    train, test = built_in_room
    first = make_model(name).fit(train.subset(torch.arange(60)))
    both = first.update(train.subset(torch.arange(60, len(train))))
    before, after = (model.predict(test.position).std.mean() for model in (first, both))
    assert after < before
    found = both.with_chosen_kernel().predict(test.position)
    assert 0.7 < covered(found.mean, found.std, test.spectrum).mean() < 0.9


def test_a_fit_like_another_keeps_its_number_of_primitives(room):
    first, some = fit(room, n_primitives=24), room.subset(torch.arange(30))
    records = []
    again = SwiftWRF(seed=1).fit(some, like=first, on_record=records.append)
    assert records == [{"stage": "final", "n_primitives": 24}]
    assert len(again.mean) == 24
    assert len(SwiftWRF(n_primitives=8).fit(some, like=first).mean) == 8
