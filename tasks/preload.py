"""Processes of a run that begin with the libraries loaded.

Loading them takes seconds in each process. A server loads them once, while the run itself reads its data, and every process
is a fork of that server.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from multiprocessing import get_context
from multiprocessing.context import BaseContext

SERVED = sys.platform == "linux"  # a fork of loaded libraries may crash on macOS, and Windows has none


def process_context() -> BaseContext:
    """Return the context in which processes are started."""
    return get_context("forkserver" if SERVED else "spawn")


def preload(modules: Sequence[str]) -> None:
    """Begin to load modules for the processes to come, where there will be some: with several threads, without torchrun."""
    several = (os.cpu_count() or 1) > 1 and os.environ.get("OMP_NUM_THREADS") != "1" and "WORLD_SIZE" not in os.environ
    if SERVED and modules and several:
        from multiprocessing import forkserver

        forkserver.set_forkserver_preload(list(modules))
        forkserver.ensure_running()
