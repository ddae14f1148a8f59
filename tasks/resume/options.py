"""Options of python -m tasks.resume, and their checks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from swiftwrf.errors import InputError
from swiftwrf.runtime.validation import PositiveInt
from tasks.claim import CONFIG, PARTIAL
from tasks.options import Options, Output, options
from tasks.records import Row, read_json

RESUMABLE = ("aoa", "rssi", "locate")


@options
class ResumeConfig(Options):
    """Continue an interrupted run of aoa, rssi or locate with its options.

    Example: swiftwrf resume runs/aoa/first.partial
    """

    run: Annotated[str, tyro.conf.Positional]
    """directory of the run, DIR.partial"""
    scheduler: str | None = None
    """address of a Dask scheduler whose workers compute the steps (extra: cluster)"""
    processes: PositiveInt | None = None
    """processes of this machine that compute the steps of aoa (default: one a thread, at most 4; one on a GPU)"""
    output: Output = Output()

    def check(self) -> None:
        super().check()
        self.saved()

    def saved(self) -> Row:
        """Return the content of the run's configuration file: task, command and config.

        Raises:
            InputError: There is no interrupted run, or it stopped before it wrote its configuration.
        """
        folder = Path(self.run)
        if not folder.name.endswith(PARTIAL) or not folder.is_dir():
            raise InputError(f"{folder} is no interrupted run; expected a directory *{PARTIAL} with a {CONFIG}")
        if not (folder / CONFIG).exists():
            raise InputError(
                f"{folder} was stopped before its {CONFIG} was written, so it holds nothing to go on with; start the run "
                "again"
            )
        content = read_json(folder / CONFIG)
        if content.get("task") not in RESUMABLE or not isinstance(content.get("config"), dict):
            raise InputError(f"{folder} is a run of the unknown task {content.get('task')!a}; restore its {CONFIG}")
        return content
