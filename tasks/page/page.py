"""A report's page: sections of text, tables and figures, written as one HTML file that opens offline."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader
from markupsafe import Markup, escape
from matplotlib.figure import Figure
from pandas import DataFrame

from swiftwrf.contrib.comparison.base import Recorded
from swiftwrf.runtime.durable import write_text
from tasks.directory import Run
from tasks.page.figures import as_svg, for_page
from tasks.preload import served_map
from tasks.records import Records, write_result, write_table
from tasks.terminal import Answer, NextStep, terminal

HALF = 92  # letters of a table that fit into half of the page
WIDE = 7.5  # [inches] figures that are wider take the whole width of the page, others half
REPORT, FIGURES = "report.html", "figures"  # its file, and the folder of its figures
MAX_SECTIONS = 5  # of a page, whose navigation has the details, too


@dataclass(frozen=True)
class Table:
    """Cells as text, which wraps where it is `long`; the rows whose first cell is in `strong` stand out."""

    columns: list[str]
    rows: list[list[str]]
    caption: str = ""
    strong: frozenset[str] = frozenset()
    long: bool = False

    @property
    def wide(self) -> bool:
        """True if it needs the whole width of the page."""
        cells = [self.columns, *self.rows]
        return self.long or sum(max(map(len, column)) + 3 for column in zip(*cells, strict=True)) > HALF


@dataclass(frozen=True)
class Plot:
    """A figure and what it shows."""

    name: str  # name of its files without suffix
    panels: Sequence[Figure]  # figures, side by side where the page is wide enough
    caption: str  # A sentence or two
    data: DataFrame  # numbers that it shows

    @property
    def widths(self) -> list[float]:
        """Widths of the panels [inches]."""
        return [float(panel.get_figwidth()) for panel in self.panels]

    @property
    def wide(self) -> bool:
        """True if it needs the whole width of the page."""
        return sum(self.widths) > WIDE

    @property
    def files(self) -> list[str]:
        """Names of the panels' files without suffix."""
        several = len(self.panels) > 1
        return [f"{self.name}-{n}" if several else self.name for n in range(1, len(self.panels) + 1)]


@dataclass(frozen=True)
class Section:
    """A heading and what follows it: paragraphs, tables, plots, meanings of names, and sections below it.

    Text between backticks is shown as code. A part that is `folded` opens by a click on its title.
    """

    title: str
    paragraphs: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)
    terms: dict[str, str] = field(default_factory=dict)
    parts: list[Section] = field(default_factory=list)
    folded: bool = False

    @property
    def all_plots(self) -> list[Plot]:
        """Plots of the section and of the sections below it."""
        return [*self.plots, *(plot for part in self.parts for plot in part.all_plots)]


@dataclass(frozen=True)
class Number:
    """One of the numbers that a reader should take away, and its meaning."""

    value: str
    meaning: str


@dataclass(frozen=True)
class Summary:
    """First screen of a page.

    It contains the conclusion, whose first sentence answers what the user asked, numbers, figures, next steps, a table of
    runs, and notes on the data.
    """

    numbers: list[Number]
    plots: list[Plot]
    conclusion: Sequence[str]
    next_steps: Sequence[NextStep]
    table: Table | None = None
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Page:
    """A report: first screen, at most `MAX_SECTIONS` sections in the navigation, and folded sections as details.

    It states the answer of its first run. A page that stands `alone`, without the directory of a run, has neither commands
    on it nor links to its files.
    """

    title: str
    summary: Summary
    sections: list[Section]
    details: list[Section] = field(default_factory=list)
    alone: bool = False
    answer: Answer | None = None

    def __post_init__(self) -> None:
        if len(self.sections) > MAX_SECTIONS:
            raise ValueError(f"a page has at most {MAX_SECTIONS} sections, got {len(self.sections)}")

    @property
    def plots(self) -> list[Plot]:
        """All plots."""
        sections = [*self.sections, *self.details]
        return [*self.summary.plots, *(plot for section in sections for plot in section.all_plots)]


def rich(text: str) -> Markup:
    """Return escaped text with code elements for what stands between backticks; a line of code breaks between words.

    Example:
        >>> str(rich("a < b: `python`"))
        'a &lt; b: <code><span>python</span></code>'
    """

    def code(found: re.Match[str]) -> str:
        return f"<code>{' '.join(f'<span>{word}</span>' for word in found[1].split(' '))}</code>"

    return Markup(re.sub("`([^`]*)`", code, str(escape(text))))  # of escaped text


def rendered(page: Page) -> tuple[str, dict[str, str]]:
    """Return the page as HTML, and the SVG of each panel in it by the name of its file without suffix."""
    panels: dict[str, Figure] = {}
    for plot in page.plots:
        for file, panel in zip(plot.files, plot.panels, strict=True):
            if file in panels:
                raise ValueError(f"two figures are called {file}; one would be shown in the other's place")
            panels[file] = panel
    captions = [plot.caption for plot in page.plots for _ in plot.panels]
    svg = dict(zip(panels, served_map(as_svg, panels.values(), captions), strict=True))
    inlined = {file: Markup(for_page(text, file)) for file, text in svg.items()}  # our own drawings; texts are escaped
    environment = Environment(
        loader=PackageLoader("tasks.page", "."), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["rich"] = rich
    return environment.get_template("template.html").render(page=page, svg=inlined), svg


def write_page(folder: Path, page: Page) -> Page:
    """Write the panels of each plot and its numbers into `figures/`, and `report.html` with the same panels inlined."""
    figures, (html, svg) = folder / FIGURES, rendered(page)
    figures.mkdir(parents=True, exist_ok=True)
    for file, text in svg.items():
        write_text(figures / f"{file}.svg", text)
    for plot in page.plots:
        write_table(figures / f"{plot.name}.csv", plot.data)
    write_text(folder / REPORT, html)
    return page


def finish(run: Run, result: Recorded, page: Callable[[list[Records]], Page], notes: Sequence[str] = ()) -> None:
    """Finish a run with its result, further notes on its data, and its report, and show its answer."""
    metrics = write_result(result, run.folder)
    metrics["notes"] = [*notes, *metrics["notes"]]
    shown = run.finish(metrics, lambda folder, values: write_page(folder, page([Records(folder, values)])))
    assert shown.answer is not None
    terminal.answer(shown.answer, run.final / REPORT)


def sections_of(
    title: str, runs: Sequence[Any], section: Callable[[Any], Section | None], terms: dict[str, str] | None = None
) -> Section:
    """Return one section, with the meanings of its names, over all runs or parts of runs that have something to show.

    Several runs have a part each, under the run's `scene`.
    """
    found = [replace(part, title=run.scene) for run in runs if (part := section(run)) is not None]
    if len(runs) == 1 and found:
        return replace(found[0], title=title, terms=terms or {})
    return Section(title, parts=found, terms=terms or {})


def number(value: float | None, digits: int = 2) -> str:
    """Return the value with `digits` decimal places, or a dash for None."""
    return "-" if value is None else f"{value:.{digits}f}"


def provenance(runs: Sequence[Records]) -> Section:
    """Command, code, versions, machine, input and time of each run."""
    tables = []
    for run in runs:
        environment = run.environment
        packages = ", ".join(f"{name} {version}" for name, version in environment["packages"].items())
        resumed = ", ".join(
            f"{session['start']} (commit {session['commit']}, {session['device']}, processes: {session['processes']})"
            for session in environment.get("resumed", [])
        )
        processes = environment.get("processes", 1)
        rows = [
            *([["run", f"{run.number}: {run.folder.name}"]] if run.number else []),
            ["command", run.config["command"]],
            ["code", f"version {environment['version']}, commit {environment['commit'] or 'unknown'}"],
            ["packages", f"Python {environment['python']}, {packages}"],
            ["machine", f"{environment['device']}"],
            *([["workers", "; ".join(environment["workers"])]] if "workers" in environment else []),
            [
                "threads",
                f"{environment['threads']}; like the seed, another number changes the networks, by up to degrees",
            ],
            *([["processes", f"{processes}; as the threads"]] if processes > 1 else []),
            ["time", f"{environment['start']} to {environment.get('end', '-')}"],
            *([["resumed", resumed]] if resumed else []),
            *([f"sha256 of {name}", digest] for name, digest in environment["input_sha256"].items()),
        ]
        tables.append(Table(["", ""], rows, long=True))
    return Section("Provenance", tables=tables)
