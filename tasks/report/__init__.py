"""Records to figures and one self-contained HTML page."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from swiftwrf import InputError
from tasks.report.aoa import aoa_page
from tasks.report.page import write_page
from tasks.report.records import Records
from tasks.report.rssi import rssi_page

PAGES = {"aoa": aoa_page, "rssi": rssi_page}


def write_report(folder: Path, metrics: dict[str, Any]) -> None:
    """Writes `figures/*.svg` and `report.html` of one run into its directory, from the records that lie there."""
    write_page(folder, PAGES[metrics["task"]]([Records(folder, metrics)]))


def merge(folders: list[Path], out: Path) -> None:
    """Writes one report over several finished runs of one task.

    Raises:
        InputError: no runs, an unfinished one, runs of several tasks, or `out` exists.
    """
    runs = [Records(folder) for folder in folders]
    tasks = sorted({run.metrics["task"] for run in runs})
    if len(tasks) != 1:
        raise InputError(f"a report takes runs of one task, got {', '.join(tasks) or 'no runs'}")
    if out.exists():
        raise InputError(f"{out} exists already and a report is never overwritten; choose another --out")
    partial = out.with_name(out.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    write_page(partial, PAGES[tasks[0]](runs))
    partial.rename(out)


__all__ = ["merge", "write_report"]
