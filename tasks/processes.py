"""Steps of a run in several processes of this machine.

A step is many small operations of torch between lines of Python, which threads of one process execute one at a time. Each
process has its share of the threads, so results depend on their number alone and not on which process computed what.
"""

from __future__ import annotations

import os
import pickle
import signal
import threading
import time
from collections.abc import Collection, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, parent_process
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import torch

from swiftwrf import FitError
from swiftwrf.runtime.progress import silent
from swiftwrf.runtime.threads import set_threads
from tasks.preload import MAX_PROCESSES, process_context
from tasks.torchrun import process_count

if TYPE_CHECKING:
    from tasks.steps import Step

MAX_SECONDS_TO_END = 10.0  # from the signal to the end of a process


def number_of_processes(device: torch.device) -> int:
    """Return the number of processes that compute the steps of a run: 1 on a GPU, with torchrun and with one thread."""
    alone = device.type != "cpu" or process_count() > 1
    return 1 if alone else min(torch.get_num_threads(), MAX_PROCESSES)


class LocalProcesses:
    """Processes that compute steps in the directory of a run.

    Args:
        number: Number of processes.
        folder: Directory of the run.
        content: File that holds the context of the steps.
    """

    def __init__(self, number: int, folder: Path, content: Path) -> None:
        self.slots: float = number
        threads = max(1, torch.get_num_threads() // number)
        self._pool = ProcessPoolExecutor(number, process_context(), _begin, (threads, folder, content))

    def submit(self, step: Step[Any]) -> Future[Any]:
        """Begin a step in a process."""
        return self._pool.submit(_compute, step)

    def next(self, pending: Collection[Future[Any]]) -> tuple[Future[Any], Any, float]:
        """Wait for one of the steps and return it with its values and its seconds.

        Raises:
            FitError: A process was killed.
            Exception: The exception of the step.
        """
        future = next(iter(wait(pending, return_when=FIRST_COMPLETED).done))
        try:
            return future, *future.result()
        except BrokenProcessPool:
            raise FitError(
                "a process of the run was killed, probably because memory was short; continue with one process by "
                "OMP_NUM_THREADS=1 swiftwrf resume DIR.partial"
            ) from None

    def close(self) -> None:
        """End the processes, whatever they compute."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        children = active_children()
        for process in children:
            process.terminate()
        for process in children:
            process.join(MAX_SECONDS_TO_END)


@contextmanager
def local_processes(number: int, folder: Path, context: object) -> Iterator[LocalProcesses]:
    """Start processes that compute steps in a directory, and end them on exit."""
    with TemporaryDirectory(prefix="swiftwrf-") as temporary:
        content = Path(temporary) / "context"
        content.write_bytes(pickle.dumps(context))
        processes = LocalProcesses(number, folder, content)
        try:
            yield processes
        finally:
            processes.close()


_context: Any = None
_folder = Path()
_threads = 1


def _begin(threads: int, folder: Path, content: Path) -> None:
    """Prepare a process."""
    global _context, _folder, _threads
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run itself ends its processes
    threading.Thread(target=_end_with_the_run, daemon=True).start()
    silent()
    _threads, _folder, _context = threads, folder, pickle.loads(content.read_bytes())


def _end_with_the_run() -> None:
    if (run := parent_process()) is not None:
        run.join()
    os._exit(1)


def _compute(step: Step[Any]) -> tuple[Any, float]:
    """Return the values of a step and its seconds."""
    set_threads(_threads)  # after the libraries of the step are loaded, so that it reaches all of them
    began = time.perf_counter()
    return step.compute(_context, _folder), time.perf_counter() - began
