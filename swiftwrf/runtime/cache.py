"""A cache of tensors that is bounded by memory, not by a number of entries."""

from __future__ import annotations

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

from torch import Tensor

MAX_CACHE_BYTES = 2**28  # of each cached function: 256 MiB
Function = TypeVar("Function", bound=Callable[..., Any])


def cached_tensors(function: Function) -> Function:
    """Keep the most recently used results of a function of hashable arguments, together at most `MAX_CACHE_BYTES`.

    A larger result is returned but not kept, so it lives as long as its caller needs it.

    Args:
        function: Returns a tensor or a tuple of tensors.

    Example:
        >>> import torch
        >>> @cached_tensors
        ... def ones(n: int) -> Tensor:
        ...     return torch.ones(n)
        >>> ones(3) is ones(3)
        True
    """
    kept: OrderedDict[Hashable, Any] = OrderedDict()
    lock = threading.Lock()

    @functools.wraps(function)
    def wrapped(*arguments: Hashable) -> Any:
        with lock:
            if arguments in kept:
                kept.move_to_end(arguments)
                return kept[arguments]
        result = function(*arguments)
        if _bytes(result) <= MAX_CACHE_BYTES:
            with lock:
                kept[arguments] = result
                while sum(map(_bytes, kept.values())) > MAX_CACHE_BYTES:
                    kept.popitem(last=False)
        return result

    return wrapped  # type: ignore[return-value]


def _bytes(result: Tensor | tuple[Tensor, ...]) -> int:
    return sum(tensor.nbytes for tensor in (result if isinstance(result, tuple) else (result,)))
