"""Options of python -m tasks.inspect, and their checks."""

from __future__ import annotations

from typing import Annotated

import tyro

from tasks.options import Options, Output, SpectraSource, TableSource, options


@options
class InspectConfig(Options):
    """Inspect measurements of any known format: counts, extents, neighbours, frames, calibration, suspicious columns.

    Example: swiftwrf inspect DIR
    """

    source: Annotated[str, tyro.conf.Positional]
    """folder or file of measurements, or name of a public data set"""
    out: str | None = None
    """directory of the page; must not exist (default: a new one under runs/inspect)"""
    output: Output = Output()
    spectra: SpectraSource = SpectraSource()
    table: TableSource = TableSource()
