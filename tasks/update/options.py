"""Options of python -m tasks.update, and their checks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro
from annotated_types import Gt, Lt

from swiftwrf.errors import InputError
from tasks.options import Options, Output, SpectraSource, TableSource, options

JSON_LINES, TABLE = (".ndjson", ".jsonl"), ".csv"
FOLLOWED = (*JSON_LINES, TABLE)


@options
class UpdateConfig(Options):
    """Update a fitted model with new measurements. Each is predicted before the model learns it, and tested for a change.

    With --follow the measurements come one by one, a JSON object a line: {"position": [x, y, z], "rssi_dbm": {"NAME": -60}}
    or {"position": [x, y, z], "spectrum": [[...], ...]}; or rows of RSSI in a CSV table, which has a column a receiver. The
    model in --out is replaced after each line.

    Example: swiftwrf update model.safetensors DIR --out updated
    """

    model: Annotated[str, tyro.conf.Positional]
    """file of a fitted model of spectra or RSSI"""
    source: Annotated[str, tyro.conf.Positional]
    """measurements of any known format in the order in which they were taken; with --follow a .ndjson or .csv file
    that grows, or - for standard input"""
    out: str
    """directory to write; must not exist. With --follow, one that exists is continued"""
    data: str | None = None
    """training measurements of the model in their order, which calibrate the test for changes of spectra, and show what
    stands in a room"""
    false_alarm_rate: Annotated[float, Gt(0), Lt(1)] = 1e-4
    """false alarms a measurement"""
    follow: bool = False
    """take measurements line by line as they come, and print a line for each"""
    output: Output = Output()
    spectra: SpectraSource = SpectraSource()
    table: TableSource = TableSource()

    def check(self) -> None:
        super().check()
        if self.follow and self.source != "-" and Path(self.source).suffix.lower() not in FOLLOWED:
            raise InputError(f"--follow takes {' or '.join(FOLLOWED)} files or -, got {self.source}")
        if self.follow and (self.output.open or self.output.json):
            raise InputError("--follow prints JSON lines and writes no page; leave out --open and --json")
