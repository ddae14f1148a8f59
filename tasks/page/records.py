"""Files of a run, opened for its report."""

from __future__ import annotations

import re
from functools import cached_property
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from pandas import DataFrame

from swiftwrf import InputError
from tasks.records import CONFIG, ENVIRONMENT, METRICS, PARTIAL, read_json, read_npz, read_table


def notes(run: Records) -> list[str]:
    """Return what the reader of the data found, in sentences; nothing for a run that did not keep it."""
    return [f"{note[0].upper()}{note[1:]}." for note in run.metrics.get("notes", [])]


class Records:
    """The files of one run.

    Args:
        folder: Directory of the run.
        metrics: Content of metrics.json. Defaults to the file in the directory.
        number: Number of the run in a report over several runs, from 1. 0 for a report over one run.

    Raises:
        InputError: The directory contains no finished run.
    """

    def __init__(self, folder: Path, metrics: dict[str, Any] | None = None, number: int = 0) -> None:
        self.folder, self.number = folder, number
        if metrics is None:
            file = folder / METRICS
            if not file.is_file():
                raise InputError(f"{folder} is no finished run: it has no {METRICS}")
            metrics = read_json(file)
        self.metrics = metrics
        self._tables: dict[str, DataFrame] = {}
        self._arrays: dict[str, dict[str, NDArray[Any]]] = {}

    @property
    def place(self) -> str:
        """The data and their split in words."""
        data = self.metrics["data"]
        return f"{'the ' + data.replace('-', ' ') if data.startswith('simulated-') else data}, {self.metrics['split']} split"

    @property
    def scene(self) -> str:
        """The data and their split in words, and which run it is where there are several."""
        return self.place + (f", run {self.number}" if self.number else "")

    @property
    def file_name(self) -> str:
        """Prefix of the names of the run's figures, unique within a report."""
        names = [re.sub(r"[^\w.=-]+", "_", self.metrics[key], flags=re.ASCII)[:40] for key in ("data", "split")]
        return "-".join([*names, f"s{self.metrics['seed']}", *([f"run{self.number}"] if self.number else [])])

    @cached_property
    def config(self) -> dict[str, Any]:
        """Command and configuration."""
        return read_json(self.folder / CONFIG)

    @cached_property
    def environment(self) -> dict[str, Any]:
        """Environment of the run: machine, versions, commit."""
        return read_json(self.folder / ENVIRONMENT)

    def table(self, name: str) -> DataFrame:
        """One of the run's tables, e.g. `errors`; not to be changed."""
        if name not in self._tables:
            self._tables[name] = read_table(self.folder / f"{name}.csv")
        return self._tables[name]

    def arrays(self, name: str) -> dict[str, NDArray[Any]]:
        """Return the arrays that the run saved in a file, e.g. `maps`, by their names; none without that file."""
        if name not in self._arrays:
            file = self.folder / f"{name}.npz"
            self._arrays[name] = read_npz(file) if file.is_file() else {}
        return self._arrays[name]

    @property
    def path(self) -> str:
        """Directory of the run as commands take it, also while the run is not finished."""
        return str(self.folder).removesuffix(PARTIAL)
