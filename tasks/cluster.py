"""Steps of a run on the workers of a Dask scheduler, for more work than one machine can take.

Results are those of this machine: a worker uses the same number of threads, must have the same versions, and makes one call
at a time, because random generators and the number of threads belong to the whole process.
"""

from __future__ import annotations

import asyncio
import ctypes
import logging
import re
import sys
import threading
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import torch

from swiftwrf import FitError, InputError
from swiftwrf.runtime.threads import set_threads
from tasks.environment import machine, packages
from tasks.run import choose_device
from tasks.terminal import console

if TYPE_CHECKING:
    from distributed import Future

CONNECT_S = 5  # until a scheduler has answered
WORKERS_S = 30  # until workers have come, at the start and after all have gone
POLL_S = 2  # between two checks that there are workers
FETCH_S = 600  # until a result has travelled from the worker to here
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # parameters of mallopt (malloc.h)
CONTINUE = "go on with --resume DIR.partial here, with --scheduler ADDRESS on a cluster"


@contextmanager
def connected(address: str | None, device: torch.device) -> Iterator[Cluster | None]:
    """Connect to the cluster of a scheduler. Yields None if there is no address.

    Raises:
        InputError: The optional extra is missing, or no scheduler or no worker answers.
    """
    if address is None:
        yield None
        return
    cluster = Cluster(address, device)
    try:
        yield cluster
    finally:
        cluster.client.close()


class Cluster:
    """The workers of a Dask scheduler. Dask repeats the calls of a worker that dies on another one.

    Args:
        address: tcp://HOST:PORT, or tls://HOST:PORT with the certificates of Dask's configuration.
        device: Device that every worker must have.

    Raises:
        InputError: See `connected`.
    """

    def __init__(self, address: str, device: torch.device) -> None:
        _check_scheduler(address)
        from distributed import Client

        for name in ("distributed", "distributed.client"):  # failures are reported here, in one sentence
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self.machines: set[str] = set()  # of the workers that have returned a result
        self.client = Client(address, timeout=CONNECT_S)
        self._address, self._device = address, device.type
        if not self._has_workers():
            self.client.close()
            raise InputError(
                f"the Dask scheduler at {address} has no workers after {WORKERS_S} s; start some: `dask worker {address}`"
            )

    def map(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        """Yield the function of each item, in order, as the built-in `map` does.

        Raises:
            FitError: The scheduler or all workers are lost, or one call ended several workers.
        """
        held, items = self.hold(function), list(items)
        futures = [self.submit(f"part {i + 1} of {len(items)}", held, item) for i, item in enumerate(items)]
        for future in futures:
            yield self.next([future])[1]

    def hold(self, thing: object) -> Future[Any]:
        """Send an object that many calls take to the cluster, once. It survives the workers that hold it."""
        import cloudpickle

        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sending large graph")
            return self.client.submit(bytes, cloudpickle.dumps(thing), key=f"data-{uuid4().hex}")

    def submit(self, name: str, function: Future[Any], item: Any, *held: Future[Any], priority: int = 0) -> Future[Any]:
        """Call a held function with the item and held objects on a worker. Calls of higher priority come first."""
        terms = (torch.get_num_threads(), self._device, packages())
        key = f"{name}-{uuid4().hex}"
        return self.client.submit(_call, terms, function, item, *held, key=key, priority=priority)

    def next(self, pending: Collection[Future[Any]]) -> tuple[Future[Any], Any]:
        """Wait for one of the calls and return it with its result.

        Raises:
            FitError: The scheduler or all workers are lost, or the call ended several workers.
            Exception: The exception of the call.
        """
        from distributed import wait

        while True:
            try:
                future = next(iter(wait(list(pending), timeout=POLL_S, return_when="FIRST_COMPLETED").done))
                error = future.exception(timeout=FETCH_S)
                value, where = (None, "") if error is not None else future.result(timeout=FETCH_S)
            except TimeoutError:
                if not self._has_workers():
                    raise self._lost("all workers of ") from None
            except (CancelledError, OSError):  # of the connection: an exception of the call is in `error`
                raise self._lost() from None
            else:
                if error is not None:
                    raise _explained(str(future.key).rpartition("-")[0], error)
                self.machines.add(where)
                return future, value

    def _lost(self, what: str = "") -> FitError:
        return FitError(f"{what}the Dask scheduler at {self._address} went away; {CONTINUE}")

    def _has_workers(self) -> bool:
        """Return True if there are workers, after waiting for them if necessary."""
        try:
            if not self.client.scheduler_info()["workers"]:
                console.print(f"waiting up to {WORKERS_S} s for workers of {self._address} ...")
                self.client.wait_for_workers(1, timeout=WORKERS_S)
        except TimeoutError:
            return False
        except OSError:
            raise self._lost() from None
        return True


def _explained(name: str, error: BaseException) -> BaseException:
    """Return the exception of a call, or one with a sentence if the call never ran."""
    from distributed import KilledWorker

    if isinstance(error, KilledWorker):
        return FitError(f"{name} ended several workers, one after the other; give them more memory, then {CONTINUE}")
    if isinstance(error, ImportError) or isinstance(error.__cause__, ImportError):
        return InputError(f"the scheduler or a worker lacks what {name} needs ({error}); install this package there")
    return error


def _check_scheduler(address: str) -> None:
    """Refuse an address at which no scheduler answers. A client of anything else would wait for ever."""
    try:
        from distributed.core import rpc
        from distributed.security import Security
    except ImportError:
        raise InputError("--scheduler needs the optional extra: pip install 'swiftwrf-tasks[cluster]'") from None
    if not re.fullmatch(r"(tcp|tls)://.+:\d{1,5}", address):
        raise InputError(f"--scheduler takes tcp://HOST:PORT or tls://HOST:PORT, got {address!a}")

    async def identity() -> str:
        async with rpc(address, connection_args=Security().get_connection_args("client")) as remote:
            return str((await asyncio.wait_for(remote.identity(), CONNECT_S))["type"])

    try:
        kind = asyncio.run(identity())
    except Exception as error:  # another server may answer anything
        reason, cure = str(error) or f"nothing in {CONNECT_S} s", "start one with `dask scheduler` and give its address"
        if address.startswith("tls"):
            cure += ", with the certificates of Dask's configuration (distributed.comm.tls)"
        raise InputError(f"no Dask scheduler answers at {address} ({reason}); {cure}") from None
    if kind != "Scheduler":
        raise InputError(f"a Dask {kind} answers at {address}; --scheduler takes the address of its scheduler")


@cache
def _keep_freed_memory() -> None:
    """Let this process keep the memory that it frees, if its C library is glibc.

    Dask makes workers return memory to the system at once. Clearing new pages took a third of a network's training.
    """
    if sys.platform == "linux" and hasattr(library := ctypes.CDLL(None), "mallopt"):
        library.mallopt(M_TRIM_THRESHOLD, 2**30)
        library.mallopt(M_MMAP_THRESHOLD, 2**25)  # the largest possible


_ONE_AT_A_TIME = threading.Lock()


def _call(terms: tuple[int, str, dict[str, str]], function: bytes, item: Any, *held: bytes) -> tuple[Any, str]:
    """Call a function on a worker and return its result with the name of the machine."""
    import cloudpickle

    threads, device, versions = terms
    with _ONE_AT_A_TIME:
        called, *things = (cloudpickle.loads(content) for content in (function, *held))
        _keep_freed_memory()
        own = packages()
        other = [f"{name} {own[name]} (not {wanted})" for name, wanted in versions.items() if own[name] != wanted]
        if other:
            raise InputError(f"a worker has {', '.join(other)}; install the same versions on all machines of a cluster")
        choose_device(device)
        set_threads(threads)  # after the libraries of the function are loaded, so that it reaches all of them
        return called(item, *things), machine(torch.device(device))
