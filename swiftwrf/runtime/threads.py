"""The device and the number of threads of computations."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cached_property
from typing import TypeVar

import torch
from threadpoolctl import ThreadpoolController, threadpool_limits

from swiftwrf.errors import InputError

Item = TypeVar("Item")
Result = TypeVar("Result")


class _Users:
    """Users of `threads_kept` that are active in this process, and the number of threads before the first of them."""

    def __init__(self) -> None:
        self.lock, self.active, self.original = threading.Lock(), 0, 0


class _LinearAlgebra:
    """Users that keep the linear algebra of NumPy and SciPy at one thread. It has one number for the whole process."""

    def __init__(self) -> None:
        self.lock, self.active = threading.Lock(), 0

    @cached_property
    def libraries(self) -> ThreadpoolController:
        import scipy.linalg  # noqa: F401  # loads the libraries, which the controller would miss later

        return ThreadpoolController().select(user_api="blas")

    @contextmanager
    def single_thread(self) -> Iterator[None]:
        with self.lock:
            if self.active == 0:
                self.limits = self.libraries.limit(limits=1)
            self.active += 1
        try:
            yield
        finally:
            with self.lock:
                self.active -= 1
                if self.active == 0:
                    self.limits.restore_original_limits()


_users, _linear_algebra = _Users(), _LinearAlgebra()
_workers: ContextVar[int | None] = ContextVar("workers", default=None)  # of `parallel_map` inside `single_thread`


def to_device(device: torch.device | str) -> torch.device:
    """Return the device of that name.

    Raises:
        InputError: Another name, or a GPU that does not exist.

    Example:
        >>> to_device("cpu")
        device(type='cpu')
    """
    try:
        found = torch.device(device)
    except (RuntimeError, TypeError, ValueError):
        raise InputError(f"device must be a device of torch, cpu or cuda, got {device!r}") from None
    if found.type == "cuda" and (found.index or 0) >= torch.cuda.device_count():
        raise InputError(f"device {found} needs an NVIDIA GPU that torch can use, and there is none; choose cpu")
    return found


def set_threads(number: int) -> None:
    """Set the number of threads of torch, which numba follows, and of the linear algebra of NumPy and SciPy.

    The number of threads is part of what makes a result repeatable, because it decides the order in which sums are added.
    A fixed number also keeps MKL from choosing one, which changes the last bits.

    Example:
        >>> set_threads(1)
        >>> torch.get_num_threads()
        1
    """
    torch.set_num_threads(number)
    threadpool_limits(number)


@contextmanager
def threads_kept() -> Iterator[None]:
    """Restore torch's number of threads on exit; also a decorator.

    Compiled loops of numba set the number of OpenMP, which torch shares. Users in several threads may overlap: torch keeps
    one number for each thread and one for threads to come, so the last user restores the number before the first.

    Example:
        >>> before = torch.get_num_threads()
        >>> with threads_kept():
        ...     torch.set_num_threads(before + 1)
        >>> torch.get_num_threads() == before
        True
    """
    before = torch.get_num_threads()
    with _users.lock:
        if _users.active == 0:
            _users.original = before
        _users.active += 1
    try:
        yield
    finally:
        with _users.lock:
            _users.active -= 1
            torch.set_num_threads(before if _users.active else _users.original)


@contextmanager
def single_thread() -> Iterator[None]:
    """Use one thread for many small operations of tensors and arrays; also a decorator.

    `parallel_map` inside still uses all threads.

    Threads synchronise after every operation. If an operation takes microseconds and other work shares the machine, most
    of the time is spent waiting: up to ten times the time of one thread.
    """
    token = _workers.set(_workers.get() or torch.get_num_threads())
    try:
        with threads_kept(), _linear_algebra.single_thread():
            torch.set_num_threads(1)
            yield
    finally:
        _workers.reset(token)


def parallel_map(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return the function of each item, computed in as many threads as torch has, with one thread inside each call.

    The threads synchronise once, so other work on the machine slows them little. Results are those of one thread.

    Example:
        >>> parallel_map(abs, [-1, 2])
        [1, 2]
    """
    workers = _workers.get() or torch.get_num_threads()
    with single_thread(), ThreadPoolExecutor(workers) as threads:
        return list(threads.map(function, items))
