"""Positions to measure next: those that reduce the predictive variance or the position error most."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from augment.choices import MAX_SUGGESTIONS
from augment.positions import sample_positions
from swiftwrf import InputError, Rssi, Spectra
from swiftwrf.data.spectra import check_training
from swiftwrf.data.splits import folds
from swiftwrf.gp import choose_kernel, most_informative, subsample
from swiftwrf.locate import RssiLocator
from swiftwrf.positions import nearest
from swiftwrf.rssi import RssiModel
from swiftwrf.rssi.coverage import Coverage, reach
from swiftwrf.rssi.maps import RssiMap

N_CANDIDATE_POSITIONS = 1500  # positions that are compared
MAX_MEASURED_POSITIONS = 2000  # measured positions that the variance is conditioned on
MIN_UNCERTAIN = 0.02  # mean of 4 p (1 - p) below which the coverage is known
BATCH_ROWS = 128  # rows whose posteriors are in memory together


@dataclass(frozen=True, eq=False)
class Suggestion:
    """Positions to measure, the most informative first.

    Args:
        position: Positions (n, 3) [m].
        variance: Mean predictive variance over the region, as a fraction of the variance of the field, before and after
            measuring at the first 1, 2, ..., n positions, (1 + n,).

    Example:
        >>> import swiftwrf
        >>> suggestion = suggest(swiftwrf.simulated_room(n=20), 3)
        >>> bool((suggestion.variance.diff() <= 0).all())
        True
    """

    position: Tensor
    variance: Tensor


def suggest(measured: Spectra, count: int, seed: int = 0) -> Suggestion:
    """Return positions in the region of the measured ones where a measurement reduces the predictive variance most.

    The variance is that of a Gaussian process whose kernel is chosen by cross-validation on the measured spectra.

    Args:
        measured: Measured spectra.
        count: Number of positions, 1 to 500.
        seed: Seed of the candidate positions.

    Raises:
        InputError: Fewer than 10 spectra, or a number outside 1 to 500.

    Example:
        >>> import swiftwrf
        >>> suggest(swiftwrf.simulated_room(n=20), 3).position.shape
        torch.Size([3, 3])
    """
    check_training(measured)
    _check_count(count)
    kernel = choose_kernel(measured.position, measured.store, folds(measured.position, "random", seed))
    candidate = sample_positions(measured.position, N_CANDIDATE_POSITIONS, seed)
    (known,) = subsample(measured.position, rows=MAX_MEASURED_POSITIONS)
    chosen, variance = most_informative(kernel, known, candidate, count)
    return Suggestion(candidate[chosen], variance)


def suggest_positions(locator: RssiLocator, train: Rssi, count: int, seed: int = 0) -> Suggestion:
    """Return positions to measure next, where position errors are large and the radio maps are uncertain.

    The positions are chosen among the locator's cells near the measured positions, one after the other. Each one lowers the
    sum over the cells of the expected squared position error times the posterior variance of the radio maps most. Rows of
    RSSI simulated with the locator's maps determine the error. The variance is that of the maps' Gaussian process, relative
    to its prior. The variance of the result is weighted in the same way.

    Args:
        locator: Locator fitted to the measured rows.
        train: Measured rows.
        count: Number of positions, 1 to 500 and at most the number of these cells.
        seed: Seed of the candidate cells and of the simulated rows.

    Raises:
        InputError: A number that is not as above, or other receivers than the locator's.

    Example:
        >>> import swiftwrf
        >>> train = swiftwrf.rssi_room(n=60)
        >>> suggest_positions(RssiLocator(n_cells=200).fit(train), train, 3).position.shape
        torch.Size([3, 3])
    """
    _check_count(count)
    if train.receiver_names != locator.receiver_names:
        raise InputError(f"{train.name} has other receivers than the locator")
    generator = torch.Generator().manual_seed(seed)
    cells = locator.cells.position
    cells = cells[locator.region.is_near(cells)]
    candidate = cells[torch.randperm(len(cells), generator=generator)[:N_CANDIDATE_POSITIONS]]
    if count > len(candidate):
        raise InputError(
            f"{count} positions cannot be chosen among {len(candidate)} cells; fit the locator with more cells"
        )
    at = candidate[torch.arange(min(400, len(candidate)))]
    error = _expected_errors(locator, at, generator)
    _, number = nearest(candidate, at, min(8, len(at)))
    weight = error[number].square().mean(dim=1).clamp_min(1e-12)
    (known,) = subsample(train.transmitter_position, rows=MAX_MEASURED_POSITIONS)
    chosen, variance = most_informative(locator.model.kernel, known, candidate, count, weight)
    return Suggestion(candidate[chosen], variance)


def suggest_scans(model: RssiModel, survey: Rssi, count: int, above_dbm: float, below: bool = False) -> Suggestion:
    """Return positions to measure next, where the maps are uncertain and so is whether a scan passes the threshold.

    The positions are inside of what was walked. Each one lowers the sum of p (1 - p) times the posterior variance of the
    field most, where p is the probability that a scan has a receiver above the threshold. The variance of the result is
    weighted in the same way. No position is returned if the maps have no field or the coverage is known.

    Args:
        model: Model fitted to the survey.
        survey: Measured rows.
        count: Number of positions, 1 to 500; fewer are returned if the walked area has fewer cells.
        above_dbm: Threshold of the coverage [dBm].
        below: True where smaller is better: scans below the threshold pass.

    Raises:
        InputError: A number outside 1 to 500.

    Example:
        >>> import swiftwrf
        >>> survey = swiftwrf.rssi_room(n=60)
        >>> suggest_scans(swiftwrf.RssiModel().fit(survey), survey, 3, above_dbm=-60).position.shape
        torch.Size([3, 3])
    """
    _check_count(count)
    none = Suggestion(torch.zeros(0, 3, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))
    if not bool(model.field_db.any()):
        return none
    floors, at = survey.floors, survey.transmitter_position
    heights = [None] if floors is None else list(floors.height_m)
    extent = (at.amax(dim=0) - at.amin(dim=0))[:2]
    edge = float(extent.prod() * len(heights) / N_CANDIDATE_POSITIONS) ** 0.5 or None
    positions, weights = [], []
    for number, height in enumerate(heights):
        scans = survey if floors is None else survey.subset(floors.number(at) == number)
        if len(scans):
            chart = RssiMap.predict(model, edge, height, scans.transmitter_position, detected=True)
            found = Coverage.of(chart, scans, (above_dbm, 0.9, 1), reach(model), below)
            y, x = found.inside.nonzero()
            cells = torch.tensor([(chart.x[i], chart.y[j], chart.height) for i, j in zip(x, y, strict=True)])
            positions.append(cells.reshape(-1, 3).double())
            p = torch.from_numpy(found.probability[found.inside])
            weights.append(p * (1 - p))
    candidate, weight = torch.cat(positions), torch.cat(weights)
    if not len(candidate) or 4 * float(weight.mean()) < MIN_UNCERTAIN:
        return none
    (known,) = subsample(at, rows=MAX_MEASURED_POSITIONS)
    chosen, variance = most_informative(model.kernel, known, candidate, min(count, len(candidate)), weight)
    return Suggestion(candidate[chosen], variance)


def _check_count(count: int) -> None:
    if not 1 <= count <= MAX_SUGGESTIONS:
        raise InputError(f"between 1 and {MAX_SUGGESTIONS} positions can be suggested, not {count}")


def _expected_errors(locator: RssiLocator, position: Tensor, generator: torch.Generator) -> Tensor:
    """Return the root-mean-square position error (n,) [m] under the posterior of one simulated row a position (n, 3)."""
    rssi = locator.sample(position, 1, generator)[0]
    errors = []
    for at, rows in zip(position.split(BATCH_ROWS), rssi.split(BATCH_ROWS), strict=True):
        posterior = locator.locate(rows)
        square = torch.cdist(at, posterior.position[0], compute_mode="donot_use_mm_for_euclid_dist").square()
        errors.append((posterior.weight * square).sum(dim=1).sqrt())
    return torch.cat(errors)
