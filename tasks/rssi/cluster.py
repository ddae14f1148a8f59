"""Groups of receivers fitted on a Dask cluster, for more of them than one machine can take."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from swiftwrf import InputError
from swiftwrf.rssi import Map


def on_cluster(address: str) -> Map:
    """A `map` that spreads its work over the workers of a scheduler; the results are the same as here.

    Raises:
        InputError: the optional extra is not installed, or nobody answers at the address.
    """
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--scheduler needs the optional extra: pip install 'swiftwrf-tasks[cluster]'") from None
    try:
        client = Client(address, timeout="5s")
    except (OSError, ValueError):
        raise InputError(f"no Dask scheduler answers at {address}; start one with `dask scheduler`") from None

    def spread(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterable[Any]:
        results: Iterable[Any] = client.gather(client.map(function, list(items), pure=False))
        return results

    return spread
