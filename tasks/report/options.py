"""Options of python -m tasks.report, and their checks."""

from __future__ import annotations

from typing import Annotated

import tyro

from tasks.options import Options, Output, options


@options
class ReportConfig(Options):
    """One report over several finished runs of one task.

    Example: swiftwrf report runs/rssi/first runs/rssi/second --out runs/report
    """

    runs: Annotated[tuple[str, ...], tyro.conf.Positional]
    """directories of the runs"""
    out: str | None = None
    """directory of the report; must not exist (default: a new one under runs/report)"""
    output: Output = Output()
