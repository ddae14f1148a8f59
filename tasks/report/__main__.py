"""python -m tasks.report RUN [RUN ...]: one report over several finished runs."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from swiftwrf import InputError
from tasks.report import merge
from tasks.run import command_line


@dataclass(frozen=True)
class ReportConfig:
    """One report over several finished runs of one task."""

    runs: Annotated[tuple[str, ...], tyro.conf.Positional]
    """directories of the runs"""
    out: str = "runs/report"
    """directory of the report; must not exist"""


def run(config: ReportConfig, resume: Path | None) -> None:
    """Writes the report."""
    if resume is not None:
        raise InputError("a report is quick and cannot be resumed; start it again")
    merge([Path(folder) for folder in config.runs], Path(config.out))
    print(f"report: {Path(config.out) / 'report.html'}")


if __name__ == "__main__":
    sys.exit(command_line("tasks.report", ReportConfig, run, sys.argv[1:]))
