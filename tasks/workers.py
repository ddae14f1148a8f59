"""Processes that compute for a run: of this machine, or the workers of a Dask scheduler.

Results are those of this process: every worker uses the same number of threads, must have the same versions, and makes one
call at a time, because random generators and the number of threads belong to the whole process.
"""

from __future__ import annotations

import asyncio
import logging
import os
import pickle
import shlex
import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import lru_cache
from multiprocessing import parent_process
from pathlib import Path
from typing import Any
from uuid import uuid4

import torch

from swiftwrf import FitError, InputError
from swiftwrf.contrib.comparison.steps import POLL_S, STEPS, packages
from swiftwrf.runtime.progress import silent
from swiftwrf.runtime.threads import set_threads, to_device
from tasks.directory import Run
from tasks.environment import machine
from tasks.preload import begin, process_context, without_main
from tasks.terminal import console

CONNECT_S = 5  # until a scheduler has answered
RESTART_S = 20  # until workers that compute a stopped run have ended
WORKERS_S = 30  # until workers have come, at the start and after all have gone
MAX_SECONDS_TO_END = 10.0  # from the signal to the end of a process
CONTINUE = "go on with swiftwrf resume DIR.partial here, with --scheduler ADDRESS on a cluster"


class Workers(Executor):
    """Processes that compute as this process would, on a device of the same type.

    `send` submits a call of a function with arguments. `hold` makes an object available to all calls and returns what stands
    for it. `slots` returns the number of processes and raises FitError if all are lost, which results raise, too.
    """

    def __init__(
        self,
        send: Callable[..., Future[Any]],
        hold: Callable[[object], Any],
        slots: Callable[[], int],
        device: torch.device,
    ) -> None:
        self.slots = slots
        self.machines: set[str] = set()  # that have returned a result
        self._send, self._hold, self._device = send, hold, device.type
        self._function: Any = None
        self._held: Any = None

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **_: Any) -> Future[Any]:
        """Call a function, which is sent once for the calls that follow, and return the future of its result."""
        if self._function is not function:
            self._function, self._held = function, self._hold(function)
        terms = torch.get_num_threads(), self._device, packages()
        result = _Result(self.slots)

        def arrive(done: Future[tuple[Any, str]]) -> None:
            try:
                value, machine = done.result()
            except BaseException as error:  # also of a cancelled call
                result.set_exception(error)
            else:
                self.machines.add(machine)
                result.set_result(value)

        with without_main():
            self._send(_call, self._held, terms, *arguments).add_done_callback(arrive)
        return result


class _Result(Future[Any]):
    """Future of a worker, which does not come if all workers are lost."""

    def __init__(self, slots: Callable[[], int]) -> None:
        super().__init__()
        self._slots = slots

    def result(self, timeout: float | None = None) -> Any:
        while timeout is None and not wait([self], POLL_S).done:
            self._slots()
        return super().result(timeout)


_ONE_AT_A_TIME = threading.Lock()  # a worker of Dask may have several threads


def _call(held: bytes | Path, terms: tuple[int, str, dict[str, str]], *arguments: Any) -> tuple[Any, str]:
    """Call a held function in a worker and return its result with the name of the machine."""
    threads, device, versions = terms
    with _ONE_AT_A_TIME:
        own = packages()
        other = [
            f"{name} {own.get(name)} (not {wanted})" for name, wanted in versions.items() if own.get(name) != wanted
        ]
        if other:
            raise InputError(f"a worker has {', '.join(other)}; install the same versions on all machines of a cluster")
        function = _loaded(held)
        set_threads(threads)  # after the libraries of the function are loaded, so that it reaches all of them
        return function(*arguments), machine(to_device(device))


def _opened(packed: bytes, held: Any) -> Any:
    """Call a packed function with a held object and the packed arguments."""
    import pickle

    call, arguments = pickle.loads(packed)
    return call(held, *arguments)


_opened.__module__ = "__main__"  # sent whole: a scheduler unpickles what it passes on, and then needs no torch


@lru_cache(maxsize=1)
def _loaded(held: bytes | Path) -> Any:
    """Return a held object. It is loaded in a call, so that the call raises the reason why it cannot be."""
    return pickle.loads(held if isinstance(held, bytes) else held.read_bytes())


@contextmanager
def local_processes(number: int, folder: Path) -> Iterator[Workers]:
    """Start processes of this machine for the run in a directory, and end them on exit, whatever they compute.

    Raises:
        FitError: A process ended.
    """
    files: list[Path] = []

    def hold(thing: object) -> Path:
        file = folder / STEPS / f".{uuid4().hex}"  # the end of the run removes it, even if this process is killed
        files.append(file)
        file.write_bytes(pickle.dumps(thing))
        return file

    pool = ProcessPoolExecutor(number, process_context(), _begin)
    started = pool._processes  # the user's program may have other children
    try:
        yield Workers(pool.submit, hold, lambda: number, torch.device("cpu"))
    except BrokenProcessPool:
        pool.shutdown()  # its own thread reads exit codes, too, and each can be read once
        codes = filter(None, [process.exitcode for process in started.values()])
        # the pool terminates the other processes
        code = min(codes, key=lambda code: (code != -signal.SIGKILL, code == -signal.SIGTERM), default=0)
        reason = f"ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        if code == -signal.SIGKILL:
            reason = "was killed, probably because memory was short"
        raise FitError(
            f"a process of the run {reason}; continue with one process: "
            f"swiftwrf resume {shlex.quote(str(folder))} --processes 1"
        ) from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in list(started.values()):
            process.terminate()
            process.join(MAX_SECONDS_TO_END)
        for file in files:
            file.unlink(missing_ok=True)


@contextmanager
def workers_of(run: Run, cluster: Workers | None) -> Iterator[Workers | None]:
    """Yield the workers of a cluster, whose machines are recorded, or the processes of the run; None if it has one alone."""
    if cluster is None and run.processes > 1:
        with local_processes(run.processes, run.folder) as processes:
            yield processes
        return
    try:
        yield cluster
    finally:
        run.computed_on(cluster.machines if cluster else ())


def _begin() -> None:
    """Prepare a process of this machine. It ends with the run."""

    def end_with_the_run() -> None:
        if (run := parent_process()) is not None:
            run.join()
        os._exit(1)

    begin()
    threading.Thread(target=end_with_the_run, daemon=True).start()
    silent()


@contextmanager
def connected(address: str | None, device: torch.device) -> Iterator[Workers | None]:
    """Connect to the workers of a Dask scheduler. Dask repeats the calls of a worker that dies on another one.

    Args:
        address: tcp://HOST:PORT, or tls://HOST:PORT with the certificates of Dask's configuration. None yields None.
        device: Device that every worker must have.

    Raises:
        InputError: The optional extra is missing, no scheduler or no worker answers, or a worker has other libraries.
        FitError: The scheduler or all workers are lost, or one call ended several workers.
    """
    if address is None:
        yield None
        return
    try:
        import cloudpickle
        from distributed import Client, KilledWorker, Security
        from distributed.comm.core import connect
    except ImportError:
        raise InputError("--scheduler needs the optional extra: pip install 'swiftwrf-tasks[cluster]'") from None
    for name in ("distributed", "distributed.client"):  # failures are reported here, in one sentence
        logging.getLogger(name).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", message="Sending large graph")  # once an object, not once a call

    async def answered() -> None:  # a client of a server that never answers would wait without end
        security = Security().get_connection_args("client")
        (await asyncio.wait_for(connect(address, **security), CONNECT_S)).abort()

    try:
        asyncio.run(answered())
        client = Client(address, timeout=CONNECT_S)
    except Exception as error:  # another server may answer anything
        reason = str(error) or f"nothing in {CONNECT_S} s"
        raise InputError(
            f"no Dask scheduler answers at {address} ({reason}); start one with `dask scheduler`"
        ) from None
    lost = FitError(f"the Dask scheduler at {address} or all its workers went away; {CONTINUE}")

    def slots(error: Exception = lost) -> int:
        with suppress(OSError):
            if client.status == "running" and not client.nthreads():
                console.print(f"waiting up to {WORKERS_S} s for workers of {address} ...")
                client.wait_for_workers(1, timeout=WORKERS_S)
            if client.status == "running":
                return len(client.nthreads())
        raise error

    def hold(thing: object) -> Any:
        return client.submit(bytes, cloudpickle.dumps(thing), pure=False)

    executor = client.get_executor(pure=False)

    def send(call: Callable[..., Any], held: Any, *arguments: Any) -> Future[Any]:
        future: Future[Any] = executor.submit(_opened, pickle.dumps((call, arguments)), held)
        return future

    def stop() -> None:  # a computation that is cancelled goes on, and calls of the next run wait for it
        with suppress(Exception):  # the scheduler is gone, or a worker has no nanny to restart it
            computing = [worker for worker, keys in client.processing().items() if client.futures.keys() & keys]
            client.restart_workers(computing, timeout=RESTART_S, raise_for_error=False)

    try:
        slots(InputError(f"the Dask scheduler at {address} has no workers; start some: `dask worker {address}`"))
        yield Workers(send, hold, slots, device)
    except KeyboardInterrupt:
        stop()
        raise
    except CancelledError:
        raise lost from None
    except KilledWorker:
        raise FitError(f"a step ended several workers; give them more memory, then {CONTINUE}") from None
    except Exception as error:
        if isinstance(error, ImportError) or isinstance(error.__cause__, ImportError):
            raise InputError(f"the scheduler or a worker lacks a package ({error}); install it there") from None
        raise
    finally:
        client.close()
