"""How many threads computations take."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from threadpoolctl import threadpool_limits


def set_threads(number: int) -> None:
    """So many threads from now on: of torch, of numba, and of the linear algebra behind NumPy and SciPy.

    Sums over threads are added up in another order, so the number belongs to what makes a result repeatable. This also
    keeps MKL from choosing one by itself, which shows in the last bits.
    """
    import numba  # by those who use it

    torch.set_num_threads(number)
    numba.set_num_threads(min(number, numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
    threadpool_limits(number)


@contextmanager
def threads_kept() -> Iterator[None]:
    """torch has as many threads afterwards as before; a decorator, too. Compiled loops of numba set the number of OpenMP,
    which torch shares."""
    before = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def single_thread() -> Iterator[None]:
    """One thread for many small tensor operations; a decorator, too.

    Several threads meet after every operation. Where these last microseconds, and other work shares the machine, they
    mostly wait for each other: ten times slower was seen.
    """
    with threads_kept():
        torch.set_num_threads(1)
        yield
