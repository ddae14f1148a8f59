"""One report over several finished runs; knows all tasks, and none of them knows it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from swiftwrf import InputError
from tasks.aoa import page as aoa
from tasks.page.page import Page, write_page
from tasks.page.records import Records
from tasks.rssi import page as rssi

PAGES: dict[str, Callable[[list[Records[Any]]], Page]] = {"aoa": aoa.page, "rssi": rssi.page}


def merge(folders: list[Path], out: Path) -> None:
    """Writes one report over several finished runs of one task.

    Raises:
        InputError: no runs, an unfinished one, runs of several tasks, or `out` exists.
    """
    runs: list[Records[Any]] = [Records(folder) for folder in folders]
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
