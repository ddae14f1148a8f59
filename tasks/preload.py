"""Processes of a run that begin with the libraries loaded.

A server loads them once, in 3.4 s of a processor, while the run itself reads its data. Every process is a fork of it, which
begins in 0.02 s and holds 160 MB, most of them shared. A process of loky loads the libraries itself: 4.8 s and 510 MB.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.context import BaseContext
from types import ModuleType
from typing import Any, TypeVar

Result = TypeVar("Result")

MAX_PROCESSES = 4  # each holds the data and a copy of the libraries, a gigabyte with a network
SERVED = sys.platform == "linux"  # a fork of loaded libraries may crash on macOS, and Windows has none

_is_served = False


def process_context() -> BaseContext:
    """Return the context in which processes are started."""
    return get_context("forkserver" if SERVED else "spawn")


@contextmanager
def without_main() -> Iterator[None]:
    """Start processes that do not import the `__main__` of this one, a script that may lack a main guard."""
    own, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = own


def preload(modules: Sequence[str]) -> None:
    """Begin to load modules for the processes to come, where there will be some: with several threads."""
    several = (os.cpu_count() or 1) > 1 and os.environ.get("OMP_NUM_THREADS") != "1"
    global _is_served
    if SERVED and modules and several:
        from multiprocessing import forkserver

        forkserver.set_forkserver_preload(["tasks.no_garbage", *modules])
        forkserver.ensure_running()
        _is_served = True


def begin() -> None:
    """Prepare a process: the run ends it, and it collects the garbage that it makes itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.freeze()
    gc.enable()


def served_map(function: Callable[..., Result], *items: Iterable[Any]) -> list[Result]:
    """Return the function of each item, like `map`, computed in forks of the server if `preload` started one, else here."""
    if not _is_served:
        return list(map(function, *items))
    number = min(os.cpu_count() or 1, MAX_PROCESSES)
    with ProcessPoolExecutor(number, process_context(), begin) as processes, without_main():
        return list(processes.map(function, *items))
