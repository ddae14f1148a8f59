"""The record of an update: a table with a row for each measurement, and what is known of all of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import torch
from pandas import DataFrame

from swiftwrf.contrib.comparison.steps import MODEL
from swiftwrf.contrib.online import Step
from swiftwrf.data.files import read_bytes
from swiftwrf.errors import InputError
from swiftwrf.positions import nearest
from swiftwrf.runtime.checkpoint import refusing
from swiftwrf.runtime.durable import write_json, write_text
from tasks.environment import command
from tasks.page import figures
from tasks.page.page import Number, Page, Plot, Section, Summary, Table
from tasks.records import Row, as_table, from_text, read_json
from tasks.terminal import NextStep

TABLE, SUMMARY = "measurements.csv", "update.json"
COLUMNS = (
    "index",
    "x_m",
    "y_m",
    "z_m",
    "error",
    "running_error",
    "innovation",
    "covered",
    "alarm",
    "correlation",
    "notice",
)
WORDS = ("alarm", "notice")  # columns of text
TYPES = dict.fromkeys(COLUMNS, float) | {"index": int} | dict.fromkeys(WORDS, object)
MEANS = ("error", "covered")  # columns whose means are kept
WINDOW = 30  # measurements of the running error
MAX_SURPRISING = 10
SURPRISE = "error / expected error"  # name of the innovation in the report
MEANING = (
    "The expected error is the standard deviation that the model predicts, for spectra up to a factor. Large values in one "
    "region show a change there. Column `innovation` of `measurements.csv`."
)
N_NEIGHBOURS = 5  # measurements whose mean innovation a map shows at each position
BLUE, RED = "#4477aa", "#ee6677"
Version = tuple[tuple[int, int], ...]  # time of change [ns] and size of each file


@dataclass(eq=False)
class Record:
    """Measurements that a model learnt one after the other. Adding one and the summary take a constant time."""

    source: str  # where the measurements come from
    unit: str  # unit of the errors
    rows: list[Row] = field(default_factory=list)  # a row of `measurements.csv` for each measurement

    alarms: list[Row] = field(default_factory=list, init=False)
    """rows that raised an alarm"""
    notices: list[Row] = field(default_factory=list, init=False)
    """rows after which the model changed beside its data"""
    _sums: dict[str, tuple[float, int]] = field(default_factory=lambda: dict.fromkeys(MEANS, (0.0, 0)), init=False)

    def __post_init__(self) -> None:
        for row in self.rows:
            self._count(row)

    def _count(self, row: Row) -> None:
        """Add a row to the alarms, notices and sums."""
        self.alarms += [row] if row["alarm"] else []
        self.notices += [row] if row["notice"] else []
        for name, (total, n) in self._sums.items():
            if not math.isnan(row[name]):
                self._sums[name] = (total + row[name], n + 1)

    def mean(self, name: str) -> float:
        """Return the mean of a column of `MEANS`, nan without numbers."""
        total, n = self._sums[name]
        return total / n if n else float("nan")

    @property
    def error_label(self) -> str:
        """Label of the errors, with their unit if they have one."""
        return f"error [{self.unit}]" if self.unit else "error"

    def with_unit(self, error: float) -> str:
        """Return an error in words; nan, that of measurements without a detection, is unknown."""
        return "unknown" if math.isnan(error) else f"{error:.3g} {self.unit}".rstrip()

    @classmethod
    def read(cls, folder: Path, count: int | None = None) -> Record:
        """Read the record in a directory, to which another process may append rows.

        Args:
            folder: Directory of an update.
            count: Number of measurements that its model has learnt. A row more is of one that a kill took from the model.

        Raises:
            InputError: There is no record, or it is damaged.
        """
        known, rows = read_json(folder / SUMMARY), _rows(folder / TABLE)[:count]
        return cls(str(known.get("source")), str(known.get("unit", "")), rows)

    def add(self, index: int, step: Step) -> Row:
        """Add a measurement and return its row."""
        scores = step.scores
        recent = [row["error"] for row in self.rows[-WINDOW + 1 :]] + [float(scores.error[0])]
        row = {
            "index": index,
            **dict(zip(("x_m", "y_m", "z_m"), scores.position[0].tolist(), strict=True)),
            "error": recent[-1],
            "running_error": float(torch.tensor(recent, dtype=torch.float64).nanmean()),
            "innovation": float(scores.innovation.square().nanmean().sqrt()),
            "covered": float(scores.covered[0]),
            "alarm": " ".join("; ".join(step.alarms).split()),  # names of receivers may contain line breaks
            "correlation": step.correlation,
            "notice": " ".join(step.notice.split()),
        }
        self._count(row)
        self.rows.append(row)
        return row

    @property
    def table(self) -> DataFrame:
        """All rows as a table."""
        return DataFrame(self.rows, columns=list(COLUMNS))

    def summary(self) -> Row:
        """Return the results as plain values."""
        changes = [
            {"measurement": row["index"], "what": row["alarm"], "correlation": row["correlation"]}
            for row in self.alarms
        ]
        return {
            "source": self.source,
            "unit": self.unit,
            "measurements": len(self.rows),
            "mean_error": self.mean("error"),
            "last_running_error": self.rows[-1]["running_error"] if self.rows else None,
            "coverage": self.mean("covered"),
            "alarms": changes,
            "notices": [{"measurement": row["index"], "what": row["notice"]} for row in self.notices],
        }

    def sentences(self) -> list[str]:
        """Return the results in sentences, whether something changed first."""
        changes, learnt = len(self.alarms), len(self.rows)
        last = self.rows[-1]["running_error"] if self.rows else math.nan
        text = [
            f"{changes or 'No'} change{'s' * (changes != 1)} detected, {learnt} measurement{'s' * (learnt != 1)} learnt.",
            f"Mean error before each was learnt: {self.with_unit(self.mean('error'))}, over the last {WINDOW}: "
            f"{self.with_unit(last)}.",
        ]
        text += [f"Change at measurement {row['index']}: {row['alarm']}." for row in self.alarms]
        return [*text, *(f"{row['notice'][0].upper()}{row['notice'][1:]}." for row in self.notices)]

    def write(self, folder: Path) -> None:
        """Write table and summary. Without measurements there is no table."""
        if self.rows:
            write_text(folder / TABLE, as_table(self.rows))
        else:
            (folder / TABLE).unlink(missing_ok=True)
        write_json(folder / SUMMARY, self.summary())

    def append(self, folder: Path, row: Row) -> None:
        """Append the last row to the table, and write the summary."""
        header, line, _ = as_table([row]).split("\r\n")
        with (folder / TABLE).open("a", encoding="utf-8", newline="") as file:
            file.write(f"{line}\r\n" if file.tell() else f"{header}\r\n{line}\r\n")
        write_json(folder / SUMMARY, self.summary())


def _rows(table: Path) -> list[Row]:
    """Return the complete lines of a table, none if there is no table yet."""
    if not table.exists():
        return []
    content = read_bytes(table)
    with refusing(f"{table} is not the table of an update"):
        rows = from_text(content[: content.rfind(b"\n") + 1].decode(), WORDS)[list(COLUMNS)]
        return list(rows.fillna(dict.fromkeys(WORDS, "")).astype(TYPES).to_dict("records"))


def next_step(folder: Path) -> NextStep:
    """Return what to do next with an update in a directory."""
    text = "Continue with the updated model"
    return NextStep(text, command("update", str(folder / MODEL), "SOURCE", "--out", "NEXT"))


def page(record: Record, name: str, folder: Path) -> Page:
    """Return the page of a record, with the name of its data, of an update in a directory."""
    numbers = [
        Number(str(len(record.rows)), "measurements learnt"),
        Number(record.with_unit(record.mean("error")), "mean error before each was learnt"),
        Number(str(len(record.alarms)), "changes detected"),
    ]
    if math.isfinite(covered := record.mean("covered")):
        numbers.append(Number(f"{covered:.0%}", "of the values inside their 80 % interval"))
    summary = Summary(numbers, [error_plot(record)], record.sentences(), [next_step(folder)])
    surprising = record.table.dropna(subset="innovation").nlargest(MAX_SURPRISING, "innovation")
    cells = [
        [str(row["index"]), *(f"{row[key]:.3g}" for key in ("x_m", "y_m", "z_m", "error", "innovation"))]
        for row in surprising.to_dict("records")
    ]
    columns = ["measurement", "x [m]", "y [m]", "z [m]", record.error_label, SURPRISE]
    table = Table(columns, cells, f"Measurements whose error is largest beside the expected one. {MEANING}")
    return Page(f"Update: {name}", summary, [Section("Surprising measurements", [], [table], [map_plot(record)])])


def error_plot(record: Record) -> Plot:
    """Return the errors over time, and the alarms."""
    figure, axes = figures.panel(7.4, 3.2)
    shown = record.table[["index", "error", "running_error"]]
    axes.plot(shown["index"], shown["error"], ".", markersize=3, color=figures.RULE)
    axes.plot(shown["index"], shown["running_error"], color=BLUE)
    for row in record.alarms:
        axes.axvline(row["index"], color=RED, linewidth=1)
    axes.set(xlabel="measurement", ylabel=record.error_label, ylim=(0, None))
    caption = f"Error of each measurement before it was learnt, mean of the last {WINDOW} (blue), and alarms (red)."
    return Plot("error", [figure], caption, shown)


def map_plot(record: Record) -> Plot:
    """Return the positions from above with their errors relative to the expected ones."""
    figure, axes = figures.panel(6.8, 5)
    shown = record.table[["x_m", "y_m", "z_m", "innovation"]].astype(float)
    position, innovation = torch.tensor(shown.to_numpy()).split([3, 1], dim=1)
    _, near = nearest(position, position, min(N_NEIGHBOURS, len(position)))
    surprise = innovation[near, 0].nanmean(dim=1)
    drawn = axes.scatter(position[:, 0], position[:, 1], s=10, c=surprise, cmap="viridis", vmin=0)
    figures.colour_bar(axes, drawn, f"{SURPRISE}, mean of the {N_NEIGHBOURS} nearest")
    caption = f"Positions from above, coloured by the error relative to the expected one. {MEANING}"
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    return Plot("changes", [figure], caption, shown.assign(innovation=surprise.numpy()))


@dataclass(frozen=True)
class FollowedView:
    """Directory of an update, which may still grow.

    Raises:
        InputError: It holds no record.
    """

    folder: Path

    def __post_init__(self) -> None:
        if not (self.folder / SUMMARY).exists():
            raise InputError(f"{self.folder} holds no record of an update: it has no {SUMMARY}")

    @property
    def title(self) -> str:
        """Title of the page."""
        return self.folder.name

    @property
    def version(self) -> Version:
        """Version of the files, which changes when a measurement is learnt."""
        found = [file.stat() for name in (TABLE, SUMMARY) if (file := self.folder / name).exists()]
        return tuple((stat.st_mtime_ns, stat.st_size) for stat in found)


@lru_cache(maxsize=1)
def snapshot(view: FollowedView, version: Version) -> tuple[Record, dict[str, str]]:
    """Return the record at a version of its files, and its figures as SVG by name; several visitors share them.

    Raises:
        InputError: The record is damaged.
    """
    record = Record.read(view.folder)
    plots = (error_plot(record), map_plot(record)) if record.rows else ()
    svg = {plot.name: figures.for_page(figures.as_svg(plot.panels[0], plot.caption), plot.name) for plot in plots}
    return record, svg
