"""Groups of receivers fitted on a Dask cluster, for more of them than one machine can take."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError
from typing import Any

from swiftwrf import FitError, InputError
from swiftwrf.rssi import Map

PATIENCE = 15  # seconds to wait for workers, at the start and when all have gone


def on_cluster(address: str) -> Map:
    """A `map` that spreads its work over the workers of a scheduler; the results are the same as here.

    Raises:
        InputError: the optional extra is not installed, nobody answers at the address, or no workers are there.
        FitError: (from the map) the scheduler or all workers went away.
    """
    try:
        from distributed import Client
        from distributed import TimeoutError as DaskTimeoutError
    except ImportError:
        raise InputError("--scheduler needs the optional extra: pip install 'swiftwrf-tasks[cluster]'") from None
    try:
        client = Client(address, timeout="5s")
    except (OSError, ValueError, TypeError, RuntimeError) as error:  # TypeError: tls:// without certificates
        raise InputError(
            f"no Dask scheduler answers at {address} ({error}); start one with `dask scheduler` and give its tcp:// address"
        ) from None
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except (DaskTimeoutError, TimeoutError):
        client.close()
        raise InputError(
            f"the Dask scheduler at {address} has no workers; start one with `dask worker {address}`"
        ) from None

    def spread(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterable[Any]:
        futures = client.map(function, list(items), pure=False)
        try:
            _wait(client, futures, address)
            results: Iterable[Any] = client.gather(futures)
        except (CancelledError, OSError, DaskTimeoutError) as error:
            raise FitError(
                f"the Dask scheduler at {address} went away ({error}); start it again, then the run"
            ) from None
        return results

    return spread


def _wait(client: Any, futures: list[Any], address: str) -> None:
    """Until all are done; a scheduler without workers would keep them for ever without a word."""
    from distributed import TimeoutError as DaskTimeoutError
    from distributed import wait

    while True:
        try:
            wait(futures, timeout=PATIENCE)
        except (DaskTimeoutError, TimeoutError):
            if client.status != "running" or not client.scheduler_info()["workers"]:
                raise FitError(
                    f"all workers of the Dask scheduler at {address} went away; start one, then go on with --resume"
                ) from None
        else:
            return
