"""How many threads small computations take."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def single_thread() -> Iterator[None]:
    """One thread for many small tensor operations; a decorator, too.

    Several threads meet after every operation. Where these last microseconds, and other work shares the machine, they
    mostly wait for each other: ten times slower was seen.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
