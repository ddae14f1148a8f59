"""The check of an estimator of the direction, in one line of the tests of another package; see `swiftwrf.testing`."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from augment import Mixed, SyntheticPositions
from augment.estimators import Estimator
from swiftwrf import AngularGrid, InputError, Spectra, simulated_room
from swiftwrf.array.angles import to_direction
from swiftwrf.contrib.testing import check_not_fitted, check_saved, close, require, require_refusal
from swiftwrf.data.spectra import to_directions
from swiftwrf.data.store import Store
from swiftwrf.runtime.checkpoint import Saved


def check_estimator(estimator: Estimator, data: Spectra | None = None) -> None:
    """Check that an estimator keeps the contract of `Estimator`, and fit it.

    It takes measured and synthetic spectra, and changes neither. Directions are azimuth and elevation in radians, the same
    for each spectrum alone and from a file, and do not depend on the labels of the spectra that it is applied to.

    Args:
        estimator: Estimator that is not fitted, with its options.
        data: Labelled spectra, at least 20. Defaults to 30 spectra of the simulated room. An estimator from array snapshots
            needs data with several snapshots of each position.

    Raises:
        AssertionError: The first sentence that does not hold.

    Example:
        >>> from augment.estimators import make_estimator
        >>> check_estimator(make_estimator("kernel_regression"))
    """
    data = data or simulated_room(n=30, grid=AngularGrid.hemisphere(15, 60))
    train, test = data.subset(torch.arange(len(data) - 8)), data.subset(torch.arange(len(data) - 8, len(data)))
    check_not_fitted(estimator)
    bare = replace(test, array=None, channel=None, frequency_hz=None)
    for rows in (data, bare):
        lacking = estimator.lacking(rows)
        require(estimator, isinstance(lacking, str), "lacking returns no text")
        if lacking:
            require_refusal(estimator, "data that lack a requirement", partial(estimator.estimate, rows), lacking)
    require(estimator, not estimator.lacking(data), "the data lack a requirement; give others")
    exact = (256 * train.spectrum).round() / 256  # in half precision, which files may have
    positions = SyntheticPositions(train.position, train.label.clone(), torch.full_like(train.index, -1))
    mixed = Mixed.measured(replace(train, store=Store(exact))).add(positions, exact.flip(2))
    before = mixed.label.clone(), mixed.spectrum.clone()
    require(estimator, estimator.fit(mixed) is estimator and estimator.is_fitted, "fit does not return the estimator")
    require(estimator, estimator.grid == data.grid, "the grid is not that of the training spectra")
    unchanged = torch.equal(mixed.label, before[0]) and torch.equal(mixed.spectrum, before[1])
    require(estimator, unchanged, "fit changes its training set")
    direction = _directions(estimator, test)
    close(estimator, _directions(estimator, test), direction, "a second estimate differs from the first", atol=0)
    other = replace(test, label=test.label.flip(0))
    close(
        estimator, _directions(estimator, other), direction, "the estimate depends on the labels of the spectra", atol=0
    )
    alone = torch.cat([_directions(estimator, test.subset(torch.tensor([row]))) for row in range(len(test))])
    close(estimator, alone, direction, "single spectra have other estimates than all at once", atol=1e-2)
    require(estimator, len(estimator.estimate(test.subset(torch.arange(0)))) == 0, "no spectra have an estimate")
    if isinstance(estimator, Saved):
        check_saved(estimator, lambda loaded: loaded.predict(test.spectrum))


def _directions(estimator: Estimator, data: Spectra) -> Tensor:
    """Return the directions of measurements as unit vectors (n, 3). Refuse what is no azimuth and elevation."""
    try:
        angles = to_directions(f"directions of {type(estimator).__name__}", estimator.estimate(data), len(data))
    except InputError as error:
        raise AssertionError(str(error)) from error
    return to_direction(*angles.unbind(dim=-1))
