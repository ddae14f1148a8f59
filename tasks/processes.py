"""Steps of a run in several processes of this machine.

A step is many small operations of torch between lines of Python, which threads of one process execute one at a time. Each
process has its share of the threads, so results depend on their number alone and not on which process computed what.
"""

from __future__ import annotations

import os
import pickle
import shlex
import signal
import threading
import time
from collections.abc import Collection, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache
from multiprocessing import parent_process
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Protocol

import torch

from swiftwrf import FitError
from swiftwrf.runtime.progress import silent
from swiftwrf.runtime.threads import set_threads
from tasks.claim import STEPS
from tasks.preload import process_context, without_main

MAX_SECONDS_TO_END = 10.0  # from the signal to the end of a process


class Computation(Protocol):
    """A step of `tasks.steps`, as a process computes it."""

    def compute(self, context: Any, folder: Path) -> Any:
        """Return plain values."""


class LocalProcesses:
    """Processes that compute steps in the directory of a run, each with the number of threads of this process.

    Args:
        number: Number of processes.
        folder: Directory of the run.
        content: File that holds the context of the steps.
    """

    def __init__(self, number: int, folder: Path, content: Path) -> None:
        self.slots: float = number
        self._context = (torch.get_num_threads(), folder, content)
        self._pool = ProcessPoolExecutor(number, process_context(), _begin)
        self._started: dict[int, BaseProcess] = {}

    def submit(self, step: Computation) -> Future[Any]:
        """Begin a step in a process.

        Raises:
            FitError: A process ended.
        """
        with self._explaining(), without_main():
            future = self._pool.submit(_compute, step, *self._context)
        self._started |= self._pool._processes  # the user's program may have other children
        return future

    def next(self, pending: Collection[Future[Any]]) -> tuple[Future[Any], Any, float]:
        """Wait for one of the steps and return it with its values and its seconds.

        Raises:
            FitError: A process ended.
            Exception: The exception of the step.
        """
        future = next(iter(wait(pending, return_when=FIRST_COMPLETED).done))
        with self._explaining():
            return future, *future.result()

    @contextmanager
    def _explaining(self) -> Iterator[None]:
        """Raise FitError with the reason if a process ended. The pool terminates the others."""
        try:
            yield
        except BrokenProcessPool:
            codes = [process.exitcode for process in self._started.values()]
            code = next((code for code in (-signal.SIGKILL, *codes) if code and code in codes), 0)
            reason = f"ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
            if code == -signal.SIGKILL:
                reason = "was killed, probably because memory was short"
            raise FitError(
                f"a process of the run {reason}; continue with one process: "
                f"swiftwrf resume {shlex.quote(str(self._context[1]))} --processes 1"
            ) from None

    def close(self) -> None:
        """End the processes, whatever they compute."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in self._started.values():
            process.terminate()
        for process in self._started.values():
            process.join(MAX_SECONDS_TO_END)


@contextmanager
def local_processes(number: int, folder: Path, context: object) -> Iterator[LocalProcesses]:
    """Start processes that compute steps in a directory, and end them on exit."""
    content = folder / STEPS / ".context"  # the end of the run removes it, even if this process is killed
    content.write_bytes(pickle.dumps(context))
    processes = LocalProcesses(number, folder, content)
    try:
        yield processes
    finally:
        processes.close()
        content.unlink(missing_ok=True)


def _begin() -> None:
    """Prepare a process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run itself ends its processes
    threading.Thread(target=_end_with_the_run, daemon=True).start()
    silent()


def _end_with_the_run() -> None:
    if (run := parent_process()) is not None:
        run.join()
    os._exit(1)


@cache
def _read(content: Path) -> Any:
    """Return the context of the steps. Each process reads it once, in a step, so that the step raises the reason."""
    return pickle.loads(content.read_bytes())


def _compute(step: Computation, threads: int, folder: Path, content: Path) -> tuple[Any, float]:
    """Return the values of a step and its seconds."""
    context = _read(content)
    set_threads(threads)  # after the libraries of the step are loaded, so that it reaches all of them
    began = time.perf_counter()
    return step.compute(context, folder), time.perf_counter() - began
