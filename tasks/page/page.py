"""A report's page: sections of text, tables and figures, written as one HTML file that opens offline."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader
from markupsafe import Markup
from matplotlib.figure import Figure

from swiftwrf.durable import write_text
from tasks.page.figures import as_svg
from tasks.page.records import Metrics, Records


@dataclass(frozen=True)
class Table:
    """Cells as text; the rows whose first cell is in `strong` stand out."""

    columns: list[str]
    rows: list[list[str]]
    caption: str = ""
    strong: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Plot:
    """A figure, the name of its file without suffix, and what it shows."""

    name: str
    figure: Figure
    caption: str


@dataclass(frozen=True)
class Section:
    """A heading and what follows it, in this order: paragraphs, tables, plots."""

    title: str
    paragraphs: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)


@dataclass(frozen=True)
class Page:
    title: str
    lead: str
    sections: list[Section]


def write_page(folder: Path, page: Page) -> None:
    """Writes `figures/NAME.svg` of each plot and `report.html` with the same figures inlined."""
    figures = folder / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    inlined: dict[str, Markup] = {}
    for section in page.sections:
        for plot in section.plots:
            if plot.name in inlined:
                raise ValueError(f"two figures are called {plot.name}; one would be shown in the other's place")
            svg = as_svg(plot.figure)
            write_text(figures / f"{plot.name}.svg", svg)
            inlined[plot.name] = Markup(svg[svg.index("<svg") :])  # our own drawing; its texts are escaped in it
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
