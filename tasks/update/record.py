"""The record of an update: a table with a row for each measurement, and what is known of all of them."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd
import torch
from torch import Tensor

from swiftwrf import InputError
from swiftwrf.online import Step
from swiftwrf.runtime.durable import write_text
from tasks.records import Row, as_table, read_json, write_json

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
WINDOW = 30  # measurements of the running error


@dataclass(frozen=True, eq=False)
class Record:
    """Measurements that a model learnt one after the other.

    Args:
        source: Where the measurements come from.
        unit: Unit of the errors, in brackets.
        rows: A row of `measurements.csv` for each measurement.
    """

    source: str
    unit: str
    rows: list[Row] = field(default_factory=list)

    @classmethod
    def read(cls, folder: Path) -> Record:
        """Read the record in a directory, to which another process may append rows.

        Raises:
            InputError: There is no record, or it is damaged.
        """
        known, rows = read_json(folder / SUMMARY), _rows(folder / TABLE)
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
            "alarm": "; ".join(step.alarms),
            "correlation": step.correlation,
            "notice": step.notice,
        }
        self.rows.append(row)
        return row

    def column(self, *names: str) -> Tensor:
        """Return columns of numbers, float64 (n,) or, of several names, (n, len(names))."""
        cells = [[torch.nan if row[name] is None else float(row[name]) for name in names] for row in self.rows]
        values = torch.tensor(cells, dtype=torch.float64).reshape(-1, len(names))
        return values[:, 0] if len(names) == 1 else values

    @property
    def alarms(self) -> list[tuple[int, str]]:
        """Number of the measurement that raised each alarm, and the change in words."""
        return [(number, row["alarm"]) for number, row in enumerate(self.rows) if row["alarm"]]

    @property
    def notices(self) -> list[tuple[int, str]]:
        """Number of the measurement after which the model changed beside its data, and how, in words."""
        return [(number, row["notice"]) for number, row in enumerate(self.rows) if row["notice"]]

    def summary(self) -> Row:
        """Return the results as plain values."""
        changes = [
            {"measurement": number, "what": text, "correlation": self.rows[number]["correlation"]}
            for number, text in self.alarms
        ]
        return {
            "source": self.source,
            "unit": self.unit,
            "measurements": len(self.rows),
            "mean_error": float(self.column("error").nanmean()),
            "last_running_error": self.rows[-1]["running_error"] if self.rows else None,
            "coverage": float(self.column("covered").nanmean()),
            "alarms": changes,
            "notices": [{"measurement": number, "what": text} for number, text in self.notices],
        }

    def sentences(self) -> list[str]:
        """Return the results in sentences."""
        found = self.summary()
        text = [
            f"{found['measurements']} measurements learnt, mean error {found['mean_error']:.4g}{self.unit} before each was "
            f"learnt, {found['last_running_error'] or float('nan'):.4g} over the last {WINDOW}"
        ]
        text += [f"change at measurement {number}: {what}" for number, what in self.alarms] or ["no change detected"]
        text += [what for _, what in self.notices]
        return text

    def write(self, folder: Path) -> None:
        """Write table and summary."""
        if self.rows:
            write_text(folder / TABLE, as_table(self.rows))
        write_json(folder / SUMMARY, self.summary())

    def append(self, folder: Path, row: Row) -> None:
        """Append the last row to the table, and write the summary."""
        header, line, _ = as_table([row]).split("\r\n")
        with (folder / TABLE).open("a", encoding="utf-8", newline="") as file:
            file.write(f"{line}\r\n" if file.tell() else f"{header}\r\n{line}\r\n")
        write_json(folder / SUMMARY, self.summary())


def resumed(folder: Path, count: int) -> Record | None:
    """Return the first rows of the record in a directory, which loses the others. None without a record.

    Args:
        folder: Directory with a model that has learnt measurements.
        count: Number of measurements that it has learnt: a row more is of one that a kill took from the model.
    """
    if not (folder / SUMMARY).exists():
        return None
    record = Record.read(folder)
    kept = Record(record.source, record.unit, record.rows[:count])
    kept.write(folder)
    return kept


def _rows(table: Path) -> list[Row]:
    """Return the complete lines of a table, none if there is no table yet."""
    if not table.exists():
        return []
    try:
        text = table.read_bytes().decode()
        rows = pd.read_csv(io.StringIO(text[: text.rfind("\n") + 1]), dtype=dict.fromkeys(WORDS, str))
        if "notice" not in rows:  # tables of earlier versions
            rows["notice"] = ""
        return list(rows[list(COLUMNS)].fillna(dict.fromkeys(WORDS, "")).to_dict("records"))
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{table} is not the table of an update ({error}); restore it") from None
