"""Comparison of localizers: each is fitted to the training rows of a split and locates the test rows."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from pandas import DataFrame, concat
from torch import Tensor

from swiftwrf.data import Rssi
from swiftwrf.data.coordinates import degree_columns
from swiftwrf.data.rssi import PLACE
from swiftwrf.data.splits import matching_validation, places
from swiftwrf.errors import InputError
from swiftwrf.locate.baselines import LEVELS, LOCALIZERS, Localizer, PosteriorLocalizer
from swiftwrf.locate.rssi import RssiLocator
from swiftwrf.metrics import ErrorSummary, method_summary, summary
from swiftwrf.rssi import estimate_offsets
from swiftwrf.runtime.checkpoint import load
from swiftwrf.runtime.registry import write_report
from swiftwrf.runtime.steps import LOCATOR, Memo, Steps
from swiftwrf.runtime.validation import checked

MIN_ROWS = 20  # training rows that a receiver detected: five folds, of which four hold at least 10 rows
ROW_FRACTIONS, RECEIVER_FRACTIONS = (0.1, 0.3), (0.25, 0.5)  # that are compared with everything
STUDIED = ("posterior", "knn")
Values = dict[str, Any]


@dataclass(frozen=True)
class Trial:
    """One localizer on a part of the data.

    Args:
        localizer: Name in the registry.
        rows: Fraction of the training rows.
        receivers: Fraction of the receivers.
    """

    localizer: str
    rows: float = 1.0
    receivers: float = 1.0

    @property
    def name(self) -> str:
        """Name of the localizer and of the part."""
        rows = f"-rows{self.rows:g}" if self.rows < 1 else ""
        return self.localizer + rows + (f"-receivers{self.receivers:g}" if self.receivers < 1 else "")

    @property
    def title(self) -> str:
        """Name of the localizer and the part in words."""
        parts = [f"{self.rows:.0%} of the rows"] * (self.rows < 1)
        parts += [f"{self.receivers:.0%} of the receivers"] * (self.receivers < 1)
        return f"{self.localizer}, {' and '.join(parts)}" if parts else self.localizer

    @property
    def is_whole(self) -> bool:
        """True if the localizer has all training rows and receivers."""
        return self.rows == 1 and self.receivers == 1


@dataclass(frozen=True, eq=False)
class LocateSplit:
    """Training and test rows that localizers are compared on.

    Args:
        train: Training rows, without offsets between groups.
        test: Test rows that a receiver detected, without offsets between groups.
        split: Name of the split, which determines how training rows are held out.
        n_cells: Number of candidate positions of the posterior.
        seed: Seed of everything random.
        n_undetected: Number of test rows that no receiver detected, which are left out.
    """

    train: Rssi
    test: Rssi
    split: str
    n_cells: int
    seed: int
    n_undetected: int

    @classmethod
    def of(cls, data: Rssi, split: str, n_cells: int, seed: int, reference: str | None = None) -> LocateSplit:
        """Return a split of RSSI; the arguments are those of `compare`.

        Offsets between groups, if there are any, are estimated from training rows and removed.

        Raises:
            InputError: Receivers that move, no such split, one of other receivers in the test rows, or too few rows in which
                a receiver detected the transmitter.
        """
        if data.receiver_moves:
            raise InputError(
                f"both ends of {data.name} move; positions are found by receivers that stay where they are"
            )
        if split == PLACE and split not in data.named_splits:
            raise InputError(
                f"split {split!r} tests other receivers than it trains; choose random or block to locate by"
            )
        train, test = data.split(split, seed)
        detected = int(train.detected.any(dim=1).sum())
        if detected < MIN_ROWS:
            raise InputError(
                f"split {split!r} of {data.name} has {detected} training rows that a receiver detected; at least {MIN_ROWS} "
                "are needed to locate by"
            )
        kept = test.detected.any(dim=1)
        if not bool(kept.any()):
            raise InputError(f"split {split!r} of {data.name} has no test rows that a receiver detected")
        test = test.subset(kept)
        if train.groups is not None:
            offsets = estimate_offsets(train, reference)
            train, test = offsets.removed(train), offsets.removed(test)
        return cls(train, test, split, n_cells, seed, int((~kept).sum()))

    def part(self, rows: float, receivers: float) -> tuple[Rssi, Rssi]:
        """Return fractions of the training rows and of the receivers, and the test rows that these receivers detected."""
        train, test = self.train, self.test
        if receivers < 1:
            columns = self._drawn(len(train.receiver_names), receivers).tolist()
            train, test = train.columns(columns), test.columns(columns)
        if rows < 1:
            train = train.subset(self._drawn(len(train), rows))
        return train, test.subset(test.detected.any(dim=1))

    def _drawn(self, n: int, fraction: float) -> Tensor:
        order = torch.randperm(n, generator=torch.Generator().manual_seed(self.seed))
        return order[: max(1, round(fraction * n))].sort().values

    def trials(self) -> Iterator[Trial]:
        """Yield every localizer on everything, then the studied ones on parts of rows and of receivers."""
        yield from (Trial(name) for name in LOCALIZERS)
        parts = [(rows, 1.0) for rows in ROW_FRACTIONS] + [(1.0, receivers) for receivers in RECEIVER_FRACTIONS]
        sizes = {(len(self.train), len(self.train.receiver_names))}
        for rows, receivers in parts:
            train, test = self.part(rows, receivers)
            size = len(train), len(train.receiver_names)
            if size not in sizes and int(train.detected.any(dim=1).sum()) >= MIN_ROWS and len(test):
                sizes.add(size)
                yield from (Trial(name, rows, receivers) for name in STUDIED)

    def fit(self, trial: Trial) -> tuple[Localizer, Values]:
        """Fit a localizer and locate the test rows. Return the localizer, and values for `LocateComparison`."""
        train, test = self.part(trial.rows, trial.receivers)
        validation = train.validation_for(self.split, test)
        if validation == "block" and self.split != "block":
            validation = matching_validation(train.transmitter_position, test.transmitter_position)
        options = {"validation": validation, "n_cells": self.n_cells, "seed": self.seed}
        localizer = LOCALIZERS[trial.localizer](**options)
        began = time.perf_counter()
        localizer.fit(train)
        fitted = time.perf_counter()
        located = localizer.locate(test.rssi_dbm)
        error = (located.position - test.transmitter_position).norm(dim=1)
        values: Values = {
            "n_train": len(train),
            "n_receivers": len(train.receiver_names),
            "seconds": {"fit": fitted - began, "predict": time.perf_counter() - fitted},
            "index": test.index,
            "truth": test.transmitter_position,
            "estimate": located.position,
            "median_m": summary(error)["median"],
        }
        optional = {name: getattr(located, name) for name in ("radius", "ambiguous", "floor_probability")}
        values |= {name: value for name, value in optional.items() if value is not None}
        if isinstance(localizer, PosteriorLocalizer):
            weight = localizer.locator.weight.tolist()
            values["weights"] = dict(zip(("values", "detections", "fingerprints"), weight, strict=True))
        return localizer, values


@dataclass(frozen=True, eq=False)
class LocateComparison:
    """Result of `compare`.

    Args:
        split: Training and test rows.
        values: What `LocateSplit.fit` gave, by trial.
        locator: Locator of all training rows.

    Example:
        >>> import swiftwrf
        >>> split, trial = LocateSplit.of(swiftwrf.rssi_room(n=60), "random", 100, 0), Trial("mean")
        >>> len(LocateComparison(split, {trial: split.fit(trial)[1]}).errors)
        12
    """

    split: LocateSplit
    values: Mapping[Trial, Values]
    locator: RssiLocator | None = None

    @cached_property
    def errors(self) -> DataFrame:
        """Position errors of the localizers with all data, a row for each method and test row."""
        return concat([table for trial, table in self._tables.items() if trial.is_whole], ignore_index=True)

    def summary(self) -> DataFrame:
        """Return a row for each method: errors [m], and their mean difference to the posterior; see `method_summary`."""
        return method_summary(self.errors, "position_error_m", "posterior")

    def report(self, file: str | Path) -> None:
        """Write the report of `swiftwrf locate` on this result into an HTML file, which opens offline.

        Raises:
            InputError: The file exists already.
        """
        write_report("locate", self, file)

    @property
    def coverage(self) -> dict[float, float]:
        """Fraction of the test positions in the credible regions of the posterior, by their probability."""
        own = self.errors[self.errors["method"] == "posterior"]
        return {p: float((own["position_error_m"] <= own[_radius(p)]).mean()) for p in LEVELS}

    @property
    def overall(self) -> dict[str, Any]:
        """Position errors in space and in plan [m] of each localizer with all data, its seconds, and its floor hit rate.

        The floor of an estimate is the one of the nearest height. Data without floors have no floor hit rate.
        """
        found: dict[str, Any] = {}
        for trial, values in self.values.items():
            if not trial.is_whole:
                continue
            table = self._tables[trial]
            found[trial.localizer] = {
                "position_error_m": summary(table["position_error_m"], table["place"]),
                "horizontal_error_m": summary(table["horizontal_error_m"], table["place"]),
                "seconds": values["seconds"],
            }
            if "floor" in table:
                found[trial.localizer]["floor_hit_rate"] = float((table["floor"] == table["truth_floor"]).mean())
        return found

    def studied(self, by: str) -> list[tuple[Trial, ErrorSummary]]:
        """Return trials and their position errors [m] for fractions `by` "rows" or "receivers", with everything included."""
        trials = [t for t in self.values if (t.receivers if by == "rows" else t.rows) == 1]
        names = {trial.localizer for trial in trials if not trial.is_whole}
        tables = ((t, self._tables[t]) for t in trials if t.localizer in names)
        return [(t, summary(table["position_error_m"], table["place"])) for t, table in tables]

    @cached_property
    def _tables(self) -> dict[Trial, DataFrame]:
        return {trial: self._table(trial) for trial in self.values}

    def _table(self, trial: Trial) -> DataFrame:
        values = self.values[trial]
        truth, estimate = (torch.as_tensor(values[name], dtype=torch.float64) for name in ("truth", "estimate"))
        away = estimate - truth
        columns: Values = {"index": values["index"], "place": places(truth, 2)}
        columns |= {"position_error_m": away.norm(dim=1), "horizontal_error_m": away[:, :2].norm(dim=1)}
        columns |= dict(zip(("x_m", "y_m", "z_m"), estimate.T, strict=True))
        columns |= dict(zip(("truth_x_m", "truth_y_m", "truth_z_m"), truth.T, strict=True))
        columns |= degree_columns(self.split.train.origin, estimate.numpy())
        if (floors := self.split.train.floors) is not None:
            columns["floor"], columns["truth_floor"] = (floors.named(at) for at in (estimate, truth))
        if "floor_probability" in values:
            columns["floor_probability"] = values["floor_probability"]
        if "radius" in values:
            radius = torch.as_tensor(values["radius"], dtype=torch.float64)
            columns |= {_radius(p): r for p, r in zip(LEVELS, radius.T, strict=True)}
            columns["ambiguous"] = values["ambiguous"]
        table = DataFrame({name: np.asarray(column) for name, column in columns.items()})
        table.insert(0, "method", trial.localizer)
        return table


def _radius(level: float) -> str:
    return f"credible_radius_{100 * level:.0f}_m"


@checked
def compare(
    data: Rssi,
    *,
    receivers: Sequence[str] = ("all",),
    split: str = "random",
    seed: int = 0,
    n_cells: int = 4000,
    reference: str | None = None,
    keep: Memo | None = None,
    executor: Executor | None = None,
) -> LocateComparison:
    """Fit every localizer to the training rows of a split, and locate the test rows.

    Two localizers are also fitted to parts of the rows and of the receivers.

    Args:
        data: RSSI at receivers that stay where they are. Offsets between its groups, if it has any, are removed.
        receivers: Names of receivers, numbers counted from 1, or "all".
        split: Split that comes with the data, or a seeded one: random or block.
        seed: Seed of everything random.
        n_cells: Number of candidate positions of the posterior.
        reference: Group whose offset is 0. Defaults to the most frequent one.
        keep: Results by the names of steps, in a folder. A call with the same data and options continues after them.
        executor: Processes that compute steps side by side, e.g. a `ProcessPoolExecutor`.

    Raises:
        InputError: Receivers that move, unknown receivers or split, or too few rows that a receiver detected.

    Example:
        >>> import swiftwrf
        >>> result = compare(swiftwrf.rssi_room(n=80), n_cells=300)
        >>> bool(result.summary().loc["posterior", "median"] < result.summary().loc["mean", "median"])
        True
    """
    measured = LocateSplit.of(data.receivers(receivers), split, n_cells, seed, reference)
    with TemporaryDirectory(prefix="swiftwrf-") as folder:
        memo = keep or Memo(Path(folder))
        steps = Steps(measured, memo, executor)
        started = {trial: steps.start(trial.name, trial.title, _locate, trial) for trial in measured.trials()}
        values = {trial: steps[name] for trial, name in started.items()}
        locator = load(memo.folder / LOCATOR)
        assert isinstance(locator, RssiLocator)
        return LocateComparison(measured, values, locator)


def _locate(split: LocateSplit, folder: Path, trial: Trial) -> Values:
    """Return the values of a trial. The locator of all training rows is saved in a folder."""
    localizer, values = split.fit(trial)
    if isinstance(localizer, PosteriorLocalizer) and trial.is_whole:
        localizer.locator.save(folder / LOCATOR)
    return values
