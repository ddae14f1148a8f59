"""How many threads computations take."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch
from threadpoolctl import threadpool_limits

Item = TypeVar("Item")
Result = TypeVar("Result")


def set_threads(number: int) -> None:
    """Set the number of threads of torch, which numba follows, and of the linear algebra behind NumPy and SciPy.

    Sums over threads are added up in another order, so the number belongs to what makes a result repeatable. This also
    keeps MKL from choosing one by itself, which shows in the last bits.
    """
    torch.set_num_threads(number)
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


def side_by_side(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """The function of each item, as many at once as torch has threads, each on one of its own.

    These meet but once, so other work on the machine costs them only what it takes, and results are those of one thread.
    """
    at_once = torch.get_num_threads()
    with single_thread(), threadpool_limits(1), ThreadPoolExecutor(at_once) as threads:
        return list(threads.map(function, items))
