"""Where to measure next: the positions that reduce the predictive variance over the region most."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from augment.positions import sample_positions
from swiftwrf import InputError, Spectra
from swiftwrf.data.spectra import check_training
from swiftwrf.data.splits import folds
from swiftwrf.gp import choose_kernel, most_informative, thinned

N_CANDIDATE_POSITIONS = 1500  # positions that are compared
MAX_SUGGESTIONS = 500
MAX_MEASURED_POSITIONS = 2000  # measured positions that the variance is conditioned on


@dataclass(frozen=True, eq=False)
class Suggestion:
    """Positions to measure, the most informative first.

    Args:
        position: Positions (n, 3) [m].
        variance: Mean predictive variance of a spectrum over the region, as a fraction of the spectra's variance, before
            and after measuring at the first 1, 2, ..., n positions, (1 + n,).
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
    if not 1 <= count <= MAX_SUGGESTIONS:
        raise InputError(f"between 1 and {MAX_SUGGESTIONS} positions can be suggested, not {count}")
    kernel = choose_kernel(measured.position, measured.store, folds(measured.position, "random", seed))
    candidate = sample_positions(measured.position, N_CANDIDATE_POSITIONS, seed)
    (known,) = thinned(measured.position, rows=MAX_MEASURED_POSITIONS)
    chosen, variance = most_informative(kernel, known, candidate, count)
    return Suggestion(candidate[chosen], variance)
