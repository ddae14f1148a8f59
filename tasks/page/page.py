"""A report's page: sections of text, tables and figures, written as one HTML file that opens offline."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader
from markupsafe import Markup
from matplotlib.figure import Figure
from pandas import DataFrame

from swiftwrf.runtime.durable import write_text
from tasks.page.figures import as_svg, for_page
from tasks.page.records import Metrics, Records
from tasks.records import write_table

HALF = 84  # letters of a table that fit into half of the page
WIDE = 7.5  # [inches] figures that are wider take the whole width of the page, others half


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
        """Whether it needs the whole width of the page."""
        cells = [self.columns, *self.rows]
        return self.long or sum(max(map(len, column)) + 3 for column in zip(*cells, strict=True)) > HALF


@dataclass(frozen=True)
class Plot:
    """A figure and what it shows.

    Args:
        name: of its files without suffix.
        figure: drawn.
        caption: in a sentence or two.
        data: the numbers that it shows, for those who draw it anew.
    """

    name: str
    figure: Figure
    caption: str
    data: DataFrame

    @property
    def width(self) -> float:
        """As it was drawn [inches]."""
        return float(self.figure.get_figwidth())

    @property
    def wide(self) -> bool:
        """Whether it needs the whole width of the page."""
        return self.width > WIDE


@dataclass(frozen=True)
class Section:
    """A heading and what follows it, in this order: paragraphs, tables, plots, and what the names in them mean."""

    title: str
    paragraphs: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)
    terms: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Number:
    """One of the numbers that a reader should take away, and what it is of."""

    value: str
    meaning: str


@dataclass(frozen=True)
class Summary:
    """What a reader sees first: numbers, a picture, the verdict in one sentence, what they mean, what to do next."""

    numbers: list[Number]
    plot: Plot
    meaning: list[str]
    next_steps: list[str]
    verdict: str = ""


@dataclass(frozen=True)
class Page:
    title: str
    summary: Summary
    sections: list[Section]

    @property
    def plots(self) -> list[Plot]:
        """All of them."""
        return [self.summary.plot, *(plot for section in self.sections for plot in section.plots)]


def write_page(folder: Path, page: Page) -> None:
    """Writes `figures/NAME.svg` and `figures/NAME.csv` of each plot and `report.html` with the same figures inlined."""
    figures = folder / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    inlined: dict[str, Markup] = {}
    for plot in page.plots:
        if plot.name in inlined:
            raise ValueError(f"two figures are called {plot.name}; one would be shown in the other's place")
        svg = as_svg(plot.figure)
        write_text(figures / f"{plot.name}.svg", svg)
        write_table(figures / f"{plot.name}.csv", plot.data.to_dict("records"))
        inlined[plot.name] = Markup(for_page(svg, plot.name))  # our own drawing; its texts are escaped in it
    environment = Environment(
        loader=PackageLoader("tasks.page", "."), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    html = environment.get_template("template.html").render(page=page, svg=inlined)
    write_text(folder / "report.html", html)


def reporting(page: Callable[[list[Records[Metrics]]], Page]) -> Callable[[Path, dict[str, Any]], None]:
    """Writes a run's report into its directory, from the records that lie there and its metrics, as this page shows it."""

    def report(folder: Path, metrics: dict[str, Any]) -> None:
        write_page(folder, page([Records(folder, metrics)]))

    return report
