"""One report over several finished runs of one task."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from swiftwrf import InputError
from tasks.aoa.page import page as aoa
from tasks.configs import ReportConfig
from tasks.directory import new_directory
from tasks.environment import stamp
from tasks.locate.page import page as locate
from tasks.page.page import Page, write_page
from tasks.page.records import Records
from tasks.rssi.page import page as rssi
from tasks.terminal import terminal

PAGES: dict[str, Callable[[list[Records]], Page]] = {"aoa": aoa, "rssi": rssi, "locate": locate}


def run(config: ReportConfig) -> None:
    """Write the report and print its place."""
    out = Path(config.out) if config.out else Path("runs") / "report" / stamp()
    merge([Path(folder) for folder in config.runs], out)
    page = out / "report.html"
    terminal.page({"runs": list(config.runs)}, "", page)


def merge(folders: list[Path], out: Path) -> None:
    """Write one report over several finished runs of one task.

    Raises:
        InputError: There are no runs, one is unfinished, their tasks differ, their records are damaged, or `out` exists.
    """
    several = len(folders) > 1
    runs = [Records(f, number=n if several else 0) for n, f in enumerate(folders, start=1)]
    tasks = sorted({str(run.metrics.get("task")) for run in runs})
    if len(tasks) != 1 or tasks[0] not in PAGES:
        raise InputError(
            f"a report takes finished runs of one task ({' or '.join(PAGES)}), got {', '.join(tasks) or 'no runs'}"
        )
    try:
        with new_directory(out, "a report") as unfinished:
            write_page(unfinished, PAGES[tasks[0]](runs))
    except InputError:
        raise
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        # the records are files that anybody may have changed, and the page uses all of them
        names = ", ".join(os.fspath(run.folder) for run in runs)
        raise InputError(
            f"the records in {names} do not hold what a report shows ({type(error).__name__}: {error}); they were changed "
            "or written by another version"
        ) from error
