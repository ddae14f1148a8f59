"""Where to measure next: the positions that tell most about the region, given what is measured."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from augment.places import draw_positions
from swiftwrf import InputError, Spectra
from swiftwrf.data.spectra import check_training
from swiftwrf.data.splits import folds
from swiftwrf.gp import choose_kernel, most_informative, thinned

CANDIDATES = 1500  # positions that are compared
MOST = 500  # that can be suggested
KNOWN = 2000  # measured positions that count at most


@dataclass(frozen=True, eq=False)
class Suggestion:
    """Positions to measure, the most telling first.

    Args:
        position: (n, 3) [m].
        left: mean variance of a spectrum over the region, as a share of the spectra's own, before measuring and once the
            first 1, 2, ... are measured, (1 + n,).
    """

    position: Tensor
    left: Tensor


def suggest(measured: Spectra, count: int, seed: int = 0) -> Suggestion:
    """Positions in the region of the measured ones where measuring lowers the uncertainty of all spectra there most.

    Args:
        measured: spectra; their positions say where the region is, and how fast they change says how far one measurement
            reaches.
        count: how many positions, 1 to 500.
        seed: of the candidates that are compared.

    Raises:
        InputError: fewer than 10 spectra, or another count.
    """
    check_training(measured)
    if not 1 <= count <= MOST:
        raise InputError(f"between 1 and {MOST} positions can be suggested, not {count}")
    kernel = choose_kernel(measured.position, measured.store, folds(measured.position, "random", seed))
    candidate = draw_positions(measured.position, CANDIDATES, seed)
    (known,) = thinned(measured.position, rows=KNOWN)
    chosen, left = most_informative(kernel, known, candidate, count)
    return Suggestion(candidate[chosen], left)
