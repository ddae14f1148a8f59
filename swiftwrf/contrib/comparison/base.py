"""Base of comparisons: methods fitted to the training rows of a split, and their errors at the test rows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, ClassVar

import torch
from numpy.typing import NDArray
from pandas import DataFrame, concat

from swiftwrf.contrib.comparison.errors import method_summary, summaries
from swiftwrf.contrib.comparison.leave_one_out import LEAVE_ONE_OUT
from swiftwrf.data import Rssi
from swiftwrf.data.dataset import PositionedData
from swiftwrf.data.splits import MAX_REPEATED, places, repeated_fraction
from swiftwrf.errors import InputError
from swiftwrf.runtime.validation import checked

Values = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Recorded:
    """Content of the files of a run: a result as a report, a table or another program reads it.

    Args:
        metrics: Content of metrics.json; `task` is the command of the run.
        tables: Tables by the names of their files without suffix.
        arrays: Arrays by the names of their files without suffix, and by their names in the file.
        source: SHA-256 of the input by name.
        folder: Folder of further files that the report shows, if there are any.
    """

    metrics: Values
    tables: Mapping[str, DataFrame]
    arrays: Mapping[str, Mapping[str, NDArray[Any]]]
    source: Mapping[str, str]
    folder: Path | None = None


class Result(ABC):
    """Errors of methods on test rows, as the command with the same result states and reports them."""

    @abstractmethod
    def recorded(self) -> Recorded:
        """Return the content of the files of a run with this result."""

    def answer(self) -> Any:
        """Return the answer of the command: the errors of all methods, the one to take, and the conclusion in words.

        Printed, it is the conclusion. `methods`, `chosen` and `conclusion` are its parts, `values()` are those of `--json`.

        Example:
            >>> import swiftwrf
            >>> swiftwrf.locate.compare(swiftwrf.rssi_room(n=80), n_cells=300).answer().chosen
            'posterior'
        """
        return _reporter()(self.recorded(), None)

    @checked
    def report(self, file: str | Path) -> None:
        """Write the report of the command into an HTML file, which opens offline.

        Raises:
            InputError: The file exists already.
        """
        _reporter()(self.recorded(), Path(file))


def _reporter() -> Callable[[Recorded, Path | None], Any]:
    """Return the function that writes the report of a result, by the entry point of the group `swiftwrf.reports`.

    Raises:
        InputError: The package is not installed, or was installed before it had this entry point.
    """
    points = tuple(entry_points(group="swiftwrf.reports"))
    if not points:
        raise InputError("nothing here writes reports; install this package again: pip install -e .")
    reporter: Callable[[Recorded, Path | None], Any] = points[0].load()
    return reporter


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Result):
    """Methods that were fitted to the training rows of a split, and their errors on its test rows; see its subclasses."""

    task: ClassVar[str]
    """command with the same result"""
    column: ClassVar[str]
    """error of the methods in `errors`"""
    further: ClassVar[tuple[str, ...]] = ()
    """further errors in `errors`"""

    train: PositionedData
    test: PositionedData
    values: Mapping[str, Values]
    options: Values

    @property
    @abstractmethod
    def model(self) -> str:
        """Name of the model of this package that all others are compared with."""

    @abstractmethod
    def _columns(self, name: str) -> Mapping[str, Any]:
        """Return the columns of the errors of one method."""

    @cached_property
    def errors(self) -> DataFrame:
        """Errors, a row for each method and test row, or pair of test row and receiver, with the number of its place."""
        return concat((DataFrame({"method": name, **self._columns(name)}) for name in self.values), ignore_index=True)

    def __repr__(self) -> str:
        medians = {name: float(median) for name, median in self.summary()["median"].items()} if self.values else {}
        best = sorted(medians, key=medians.__getitem__)[:3]
        errors = ", ".join(f"{name} {medians[name]:.3g}" for name in best) or "none"
        return (
            f"<{type(self).__name__} of {self.train.name}: {len(self.values)} methods, {len(self.train)} training and "
            f"{len(self.test)} test rows;\n lowest median errors: {errors}>"
        )

    def to_latex(self) -> str:
        r"""Return the summary as a table of LaTeX, for the package booktabs: median, 95 % interval, mean, 90th percentile.

        Example:
            >>> import swiftwrf
            >>> print(swiftwrf.rssi.compare(swiftwrf.rssi_room(n=60), receivers=["6"]).to_latex().splitlines()[0])
            \begin{tabular}{lrrrr}
        """
        lines = [r"\begin{tabular}{lrrrr}", r"\toprule", r"method & median & 95\,\% interval & mean & 90\,\% below \\"]
        lines.append(r"\midrule")
        for name, row in self.summary().sort_values("median").iterrows():
            interval = f"{row['low']:.2f} to {row['high']:.2f}"
            cells = (
                str(name).replace("_", r"\_"),
                f"{row['median']:.2f}",
                interval,
                f"{row['mean']:.2f}",
                f"{row['p90']:.2f}",
            )
            lines.append(" & ".join(cells) + r" \\")
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"

    def summary(self) -> DataFrame:
        """Return a row for each method: errors, and their mean difference to those of `model`; see `method_summary`."""
        return method_summary(self.errors, self.column, self.model)

    @property
    def overall(self) -> dict[str, Values]:
        """Summaries of the errors of each method over test places, and its seconds."""
        found = summaries(self.errors, "method", (self.column, *self.further))
        return {name: {**found[name], "seconds": self.values[name]["seconds"]} for name in self.values}

    @property
    def notes(self) -> list[str]:
        """Sentences on the split, the data and the offsets between groups of RSSI."""
        train, test = self.train, self.test
        if not (isinstance(train, Rssi) and isinstance(test, Rssi)):
            return list(train.notes)
        offsets = [] if train.offsets is None else [train.offsets.note()]
        return [*split_notes(train, test, self.options["split"]), *train.notes, *offsets]

    def recorded(self) -> Recorded:
        metrics = {
            "task": self.task,
            "data": self.train.name,
            "notes": self.notes,
            **self.options,
            "n_train": len(self.train),
            "n_test": len(self.test),
            "overall": self.overall,
            "held_out": self.values[self.model].get("held_out", {}),
        }
        return Recorded(metrics, {"errors": self.errors}, {}, self.train.source)


def split_notes(train: Rssi, test: Rssi, split: str) -> list[str]:
    """Return notes on sessions and on rows that share positions.

    Example:
        >>> import swiftwrf
        >>> split_notes(*swiftwrf.rssi_room(n=60).split(), "random")
        []
    """
    if split == LEAVE_ONE_OUT:
        count = int(places(test.transmitter_position).max()) + 1
        return [
            f"{len(test)} rows are too few for a test part: rows of each of {count} positions are predicted by those of all "
            f"others, and errors and intervals of so few vary by chance"
        ]
    notes = []
    if train.validation_for(split, test) == "session":
        notes.append(
            "the test rows are of other sessions than the training rows, so cross-validation holds out sessions"
        )
    repeated = repeated_fraction(train.transmitter_position, test.transmitter_position)
    position = torch.cat([train.transmitter_position, test.transmitter_position])
    n_places = int(places(position).max()) + 1
    if repeated > MAX_REPEATED:
        notes.append(f"this split tests look-up: {repeated:.0%} of the test rows are at places of training rows")
    elif n_places < len(position) and not repeated:
        notes.append(f"{len(position)} rows are at {n_places} places, each of which is in one part of the split")
    return notes
