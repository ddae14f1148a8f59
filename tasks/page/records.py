"""What a run has left on disk, read back for its report."""

from __future__ import annotations

import json
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

import pandas as pd

from swiftwrf import InputError
from tasks.metrics import RunMetrics

Metrics = TypeVar("Metrics", bound=RunMetrics)


class Records(Generic[Metrics]):
    """The files of one run.

    Args:
        folder: its directory.
        metrics: the content of metrics.json, read from the directory unless given.

    Raises:
        InputError: not the directory of a finished run.
    """

    def __init__(self, folder: Path, metrics: dict[str, Any] | None = None) -> None:
        self.folder = folder
        if metrics is None:
            file = folder / "metrics.json"
            if not file.is_file():
                raise InputError(f"{folder} is no finished run: it has no metrics.json")
            metrics = json.loads(file.read_text())
        self.metrics = cast(Metrics, metrics)

    @cached_property
    def config(self) -> dict[str, Any]:
        """Command and configuration."""
        return self._json("config.json")

    @cached_property
    def environment(self) -> dict[str, Any]:
        """Where it ran."""
        return self._json("environment.json")

    def table(self, name: str) -> pd.DataFrame:
        """One of the run's tables, e.g. `errors`."""
        return pd.read_csv(self.folder / f"{name}.csv")

    def _json(self, name: str) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.folder / name).read_text())
        return content
