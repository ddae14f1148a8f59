"""Work on the workers of a Dask scheduler, for more of it than one machine can take.

The numbers are those of this machine: a worker takes as many threads, must have the same versions, and does one thing at a
time (random generators and the number of threads belong to the whole process).
"""

from __future__ import annotations

import asyncio
import ctypes
import logging
import sys
import threading
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import torch

from swiftwrf import FitError, InputError
from swiftwrf.runtime.threads import set_threads
from tasks.directory import console
from tasks.environment import machine, packages
from tasks.run import choose_device
from tasks.torchrun import process_count

if TYPE_CHECKING:
    from distributed import Future

CONNECT = 5  # seconds that a scheduler has to answer
PATIENCE = 30  # seconds to wait for workers, at the start and when all have gone
LOOK = 2  # seconds between two looks whether there are any
FETCH = 600  # seconds that a result may take from the worker to here
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of mallopt (malloc.h)
GO_ON = "go on with --resume DIR.partial here, with --scheduler ADDRESS on a cluster"


@contextmanager
def connected(address: str | None, device: torch.device) -> Iterator[Cluster | None]:
    """The cluster of the scheduler at this address; None where there is no address.

    Raises:
        InputError: the optional extra is not installed, the address cannot be one, nobody answers there, no workers come, or
            torchrun started this process.
    """
    if address is None:
        yield None
        return
    if process_count() > 1:
        raise InputError("--scheduler and torchrun both spread the steps of a run; use one of them")
    cluster = Cluster(address, device)
    try:
        yield cluster
    finally:
        cluster.close()


class Cluster:
    """The workers of a Dask scheduler; a worker that dies is replaced by another one.

    Args:
        address: tcp://HOST:PORT, or tls:// with the certificates of Dask's own configuration.
        device: that every worker must have.

    Raises:
        InputError: see `connected`.
    """

    def __init__(self, address: str, device: torch.device) -> None:
        _check_address(address)
        from distributed import Client

        for name in ("distributed", "distributed.client"):  # what goes wrong is said here, in a sentence
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            answers = asyncio.run(_who(address))
        except Exception as error:  # whatever is there may answer anything
            reason = str(error) or f"nothing in {CONNECT} s"
            raise InputError(
                f"no Dask scheduler answers at {address} ({reason}); start one with `dask scheduler` and give its address"
            ) from None
        if answers != "Scheduler":
            raise InputError(f"a Dask {answers} answers at {address}; --scheduler takes the address of its scheduler")
        self.machines: set[str] = set()
        self._address, self._device = address, device.type
        self._client = Client(address, timeout=CONNECT)
        if not self._workers_come():
            self.close()
            raise InputError(
                f"the Dask scheduler at {address} has no workers after {PATIENCE} s; start some with `dask worker {address}`"
            )

    def close(self) -> None:
        """Leaves the scheduler; what it still holds of this work is dropped."""
        self._client.close()

    def map(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        """As the built-in function, on the workers.

        Raises:
            FitError: the scheduler or all workers went away, or one item ended several workers.
        """
        held, items = self.hold(function), list(items)
        futures = [self.submit(f"part {i + 1} of {len(items)}", held, item) for i, item in enumerate(items)]
        done: dict[Future[Any], Any] = {}
        for future in futures:
            while future not in done:
                ready, value = self.next([other for other in futures if other not in done])
                done[ready] = value
            yield done[future]

    def hold(self, thing: object) -> Future[Any]:
        """Something that many calls take, sent once. The scheduler keeps a copy in case the workers that have it die."""
        import cloudpickle

        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sending large graph")
            return self._client.submit(bytes, cloudpickle.dumps(thing), key=f"data-{uuid4().hex}")

    def submit(
        self, name: str, function: Future[Any], item: Any, *held: Future[Any], urgent: bool = False
    ) -> Future[Any]:
        """Calls `function` (as held) with the item and what else is held, on some worker; urgent calls come first."""
        terms = _Terms(torch.get_num_threads(), self._device, _versions())
        key = f"{name}-{uuid4().hex}"
        return self._client.submit(_call, terms, function, item, *held, key=key, priority=int(urgent))

    def next(self, pending: Collection[Future[Any]]) -> tuple[Future[Any], Any]:
        """One of these that is done, and what it gave.

        Raises:
            FitError: the scheduler or all workers went away, or the call ended several workers.
            Exception: what the call raised.
        """
        from distributed import wait

        while True:
            try:
                future = next(iter(wait(list(pending), timeout=LOOK, return_when="FIRST_COMPLETED").done))
                error = future.exception(timeout=FETCH)
                result = (None, "") if error is not None else future.result(timeout=FETCH)
            except TimeoutError:
                if not self._workers_come():
                    raise FitError(f"all workers of the Dask scheduler at {self._address} went away; {GO_ON}") from None
            except (CancelledError, OSError):  # the connection's: what a call raised is returned above
                raise FitError(f"the Dask scheduler at {self._address} went away; {GO_ON}") from None
            else:
                if error is not None:
                    raise _in_words(str(future.key).rpartition("-")[0], error)
                value, where = result
                self.machines.add(where)
                return future, value

    def _workers_come(self) -> bool:
        """Whether there are workers, after some waiting if need be."""
        try:
            if not self._client.scheduler_info()["workers"]:
                console.print(f"waiting up to {PATIENCE} s for workers of {self._address} ...")
                self._client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            return False
        except OSError as error:
            raise FitError(f"the Dask scheduler at {self._address} went away ({error}); {GO_ON}") from None
        return True


def _in_words(name: str, error: BaseException) -> BaseException:
    """The error that a call raised; a sentence where it got nowhere."""
    from distributed import KilledWorker

    if isinstance(error, KilledWorker):
        return FitError(f"{name} ended several workers, one after the other; give them more memory, then {GO_ON}")
    if isinstance(error, ImportError) or isinstance(error.__cause__, ImportError):
        return InputError(f"the scheduler or a worker lacks what {name} needs ({error}); install this package there")
    return error


def _check_address(address: str) -> None:
    """Refuses what no client should be made for: one that fails half-made stays behind in the process.

    Raises:
        InputError: no such address, or a tls:// one without certificates.
    """
    try:
        from distributed.comm.addressing import parse_address, parse_host_port
        from distributed.security import Security
    except ImportError:
        raise InputError("--scheduler needs the optional extra: pip install 'swiftwrf-tasks[cluster]'") from None
    try:
        scheme, place = parse_address(address)
        parse_host_port(place)
    except ValueError:
        scheme = ""
    if scheme not in ("tcp", "tls"):
        raise InputError(f"--scheduler takes tcp://HOST:PORT or tls://HOST:PORT, got {address!a}")
    if scheme == "tls":
        try:
            context = Security().get_connection_args("client").get("ssl_context")
        except OSError as error:
            raise InputError(f"--scheduler {address}: a certificate of Dask's configuration fails ({error})") from None
        if context is None:
            raise InputError(
                f"--scheduler {address} needs certificates: name them in Dask's configuration "
                "(distributed.comm.tls.ca-file and .client.cert) or use tcp://"
            )


async def _who(address: str) -> str:
    """What of Dask answers at this address. A client would wait for ever where something else does."""
    from distributed.core import rpc
    from distributed.security import Security

    async with rpc(address, connection_args=Security().get_connection_args("client")) as remote:
        return str((await asyncio.wait_for(remote.identity(), CONNECT))["type"])


@dataclass(frozen=True)
class _Terms:
    """What the numbers depend on beside data and settings."""

    threads: int
    device: str
    versions: dict[str, str]

    def meet(self) -> None:
        """Makes this process such that the numbers are those of the one that asks.

        Raises:
            InputError: that cannot be.
        """
        own = _versions()
        other = [f"{name} {own[name]} (not {wanted})" for name, wanted in self.versions.items() if own[name] != wanted]
        if other:
            raise InputError(f"a worker has {', '.join(other)}; install the same versions on all machines of a cluster")
        choose_device(self.device)
        set_threads(self.threads)


def _versions() -> dict[str, str]:
    return {"swiftwrf-tasks": version("swiftwrf-tasks")} | packages()


@cache
def _keep_memory() -> None:
    """What this process frees it keeps for itself, where its C library is glibc.

    Dask has its workers return memory to the system at once, and with that each block of 128 KiB and more comes from the
    system anew: clearing those pages took a third of the time that a network trained.
    """
    if sys.platform == "linux" and hasattr(library := ctypes.CDLL(None), "mallopt"):
        library.mallopt(M_TRIM_THRESHOLD, 2**30)
        library.mallopt(M_MMAP_THRESHOLD, 2**25)  # the most that it takes


_ONE_AT_A_TIME = threading.Lock()


def _call(terms: _Terms, function: bytes, item: Any, *held: bytes) -> tuple[Any, str]:
    """On a worker: what the function gives, and the machine."""
    import cloudpickle

    with _ONE_AT_A_TIME:
        called, *things = (cloudpickle.loads(content) for content in (function, *held))
        _keep_memory()
        terms.meet()  # after the libraries behind the function are loaded: their threads count, too
        return called(item, *things), machine(torch.device(terms.device))
