"""The device and the number of threads of computations."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache, partial
from typing import Generic, TypeVar

import torch
from threadpoolctl import ThreadpoolController, threadpool_limits

from swiftwrf.errors import InputError

Item = TypeVar("Item")
Result = TypeVar("Result")
State = TypeVar("State")


class _Shared(Generic[State]):
    """A setting of the whole process: users in several threads may overlap, and the last one restores it.

    Args:
        begin: Called before the first user. Returns the state to restore.
        end: Called with this state after the last user.
    """

    def __init__(self, begin: Callable[[], State], end: Callable[[State], object]) -> None:
        self._lock, self._active, self._begin, self._end = threading.Lock(), 0, begin, end

    @contextmanager
    def used(self) -> Iterator[None]:
        with self._lock:
            if self._active == 0:
                self._state = self._begin()
            self._active += 1
        try:
            yield
        finally:
            with self._lock:
                self._active -= 1
                if self._active == 0:
                    self._end(self._state)


@cache
def _linear_algebra() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401  # loads the libraries, which the controller would miss later

    return ThreadpoolController().select(user_api="blas")


_torch_threads = _Shared(torch.get_num_threads, torch.set_num_threads)
_one_blas_thread = _Shared(lambda: _linear_algebra().limit(limits=1), lambda limits: limits.restore_original_limits())
_threads = torch.get_num_threads()
# of `parallel_map`: all threads that torch has at the start, also where processes of a run share them, because an idle
# process leaves its own to the others; 1 inside
_workers: ContextVar[int] = ContextVar("workers", default=_threads)


if hasattr(os, "register_at_fork"):  # a forked process would wait for threads of OpenMP that it does not have
    os.register_at_fork(after_in_child=partial(torch.set_num_threads, 1))


def to_device(device: torch.device | str) -> torch.device:
    """Return the device of that name.

    Raises:
        InputError: Another name, or a GPU that does not exist.

    Example:
        >>> to_device("cpu")
        device(type='cpu')
    """
    known = None
    with suppress(RuntimeError, TypeError, ValueError):
        known = torch.device(device)
    if known is None or known.type not in ("cpu", "cuda"):
        raise InputError(f"device must be a device of torch, cpu or cuda, got {str(device)!r}")
    if known.type == "cuda" and (known.index or 0) >= torch.cuda.device_count():
        raise InputError(f"device {known} needs an NVIDIA GPU that torch can use, and there is none; choose cpu")
    return known


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
    with _torch_threads.used():
        try:
            yield
        finally:
            torch.set_num_threads(before)


@contextmanager
def single_thread() -> Iterator[None]:
    """Use one thread for many small operations of tensors and arrays; also a decorator.

    `parallel_map` inside still uses several.

    Threads synchronise after every operation. If an operation takes microseconds and other work shares the machine, most
    of the time is spent waiting: up to ten times the time of one thread.
    """
    with threads_kept(), _one_blas_thread.used():
        torch.set_num_threads(1)
        yield


def parallel_map(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return the function of each item, computed in as many threads as torch had at the start, with one inside each call.

    The threads synchronise once, so other work on the machine slows them little. Results are those of one thread.

    Example:
        >>> parallel_map(abs, [-1, 2])
        [1, 2]
    """
    with single_thread(), ThreadPoolExecutor(_workers.get(), initializer=_workers.set, initargs=(1,)) as threads:
        return list(threads.map(function, items))
