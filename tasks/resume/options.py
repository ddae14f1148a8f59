"""Options of python -m tasks.resume."""

from __future__ import annotations

from typing import Annotated

import tyro

from tasks.options import Options, Output, options


@options
class ResumeConfig(Options):
    """Continue an interrupted run of aoa, rssi or locate with its options.

    Example: python -m tasks.resume runs/aoa/first.partial
    """

    run: Annotated[str, tyro.conf.Positional]
    """directory of the run, DIR.partial"""
    scheduler: str | None = None
    """address of a Dask scheduler whose workers compute the steps (extra: cluster)"""
    processes: int | None = None
    """processes of this machine that compute the steps of aoa (default: one a thread, at most 4; one on a GPU)"""
    output: Output = Output()
