"""Reports of finished runs of one task, and of a result of the library."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import matplotlib.style

from swiftwrf import InputError
from swiftwrf.contrib.comparison.base import Recorded
from swiftwrf.runtime.checkpoint import refusing
from swiftwrf.runtime.durable import write_text
from tasks.aoa import page as aoa
from tasks.command import run_module
from tasks.configs import ReportConfig
from tasks.directory import check_new_file, new_directory
from tasks.environment import choose_device, environment, stamp
from tasks.locate import page as locate
from tasks.page.figures import STYLE
from tasks.page.page import FIGURES, REPORT, Page, rendered, write_page
from tasks.records import Records
from tasks.rssi import page as rssi
from tasks.terminal import Answer, terminal

CALLS = {"aoa": "augment.turbo_learning", "rssi": "swiftwrf.rssi.compare", "locate": "swiftwrf.locate.compare"}
PAGES = {"aoa": aoa.page, "rssi": rssi.page, "locate": locate.page}
ANSWERS = {"aoa": aoa.answer_of, "rssi": rssi.answer, "locate": locate.answer}


def run(config: ReportConfig) -> None:
    """Write the report and print its place."""
    out = Path(config.out) if config.out else Path("runs") / "report" / stamp()
    merge([Path(folder) for folder in config.runs], out, pdf=config.pdf)
    page = out / REPORT
    terminal.page({"runs": list(config.runs)}, "", page)


def write(result: Recorded, file: Path | None) -> Answer | None:
    """Return the answer of a result of the library, or write its report into an HTML file, without a directory of a run.

    Args:
        result: Content of the files of a run with it.
        file: New file. None for the answer.

    Raises:
        InputError: The file is no .html, exists already, or its folder does not.
    """
    if file is not None:
        check_new_file(file, (".html", ".htm"))
    task: str = result.metrics["task"]
    records = Records.of(result, {"command": CALLS[task]})
    if file is None:
        return ANSWERS[task](records)
    records.environment = environment(choose_device("cpu"), dict(result.source))
    write_text(file, rendered(replace(PAGES[task]([records]), alone=True))[0])
    return None


def write_pdf(folder: Path, page: Page) -> None:
    """Write the panels of each plot into `figures/` as PDF."""
    with matplotlib.style.context(STYLE):
        for plot in page.plots:
            for name, panel in zip(plot.files, plot.panels, strict=True):
                panel.savefig(folder / FIGURES / f"{name}.pdf", metadata={"CreationDate": None})


def merge(folders: list[Path], out: Path, *, pdf: bool = False) -> None:
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
    names = ", ".join(os.fspath(run.folder) for run in runs)
    with new_directory(out, "a report") as unfinished, refusing(f"{names} does not hold what a report shows"):
        page = write_page(unfinished, PAGES[tasks[0]](runs))
        if pdf:
            write_pdf(unfinished, page)


if __name__ == "__main__":
    raise SystemExit(run_module("tasks.report"))
