"""Steps of the experiment: a localizer is fitted to training rows, or a part of them, and locates the test rows."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.suggest import suggest_positions
from swiftwrf import Rssi
from swiftwrf.data.coordinates import degree_columns
from swiftwrf.locate import RssiLocator
from swiftwrf.locate.baselines import LOCALIZERS, PosteriorLocalizer
from swiftwrf.runtime.durable import write_npz
from swiftwrf.runtime.steps import Step
from tasks.claim import LOCATOR
from tasks.records import Row, write_table

MAPS = "maps.npz"
SUGGESTED = "suggested"
MIN_ROWS = 20  # training rows that a receiver detected: five folds, of which four hold at least 10 rows
ROW_FRACTIONS, RECEIVER_FRACTIONS = (0.1, 0.3), (0.25, 0.5)  # that are compared with everything
STUDIED = ("posterior", "knn")
N_MAPS = 6  # test rows with a posterior map


@dataclass(frozen=True, eq=False)
class Experiment:
    """Data and options that all steps of a run share.

    Args:
        train: Training rows of the split.
        test: Test rows of the split.
        split: Name of the split, which determines how training rows are held out.
        cells: Number of candidate positions of the posterior.
        seed: Seed of everything random.
        suggest: Number of positions to suggest for the next measurements.
    """

    train: Rssi
    test: Rssi
    split: str
    cells: int
    seed: int
    suggest: int = 0

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

    def steps(self) -> Iterator[Localization]:
        """Yield every localizer on everything, then the studied ones on parts of rows and of receivers."""
        yield from (Localization(name) for name in LOCALIZERS)
        parts = [(rows, 1.0) for rows in ROW_FRACTIONS] + [(1.0, receivers) for receivers in RECEIVER_FRACTIONS]
        sizes = {(len(self.train), len(self.train.receiver_names))}
        for rows, receivers in parts:
            train, test = self.part(rows, receivers)
            size = len(train), len(train.receiver_names)
            if size not in sizes and int(train.detected.any(dim=1).sum()) >= MIN_ROWS and len(test):
                sizes.add(size)
                yield from (Localization(name, rows, receivers) for name in STUDIED)


@dataclass(frozen=True)
class Localization(Step[Experiment]):
    """Fit a localizer and locate the test rows.

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
        rows = f"-rows{self.rows:g}" if self.rows < 1 else ""
        return self.localizer + rows + (f"-receivers{self.receivers:g}" if self.receivers < 1 else "")

    @property
    def title(self) -> str:
        parts = [f"{self.rows:.0%} of the rows"] * (self.rows < 1)
        parts += [f"{self.receivers:.0%} of the receivers"] * (self.receivers < 1)
        return f"{self.localizer}, {' and '.join(parts)}" if parts else self.localizer

    @property
    def is_whole(self) -> bool:
        """True if the localizer has all training rows and receivers."""
        return self.rows == 1 and self.receivers == 1

    def compute(self, context: Experiment, folder: Path) -> Row:
        train, test = context.part(self.rows, self.receivers)
        options = {
            "validation": train.validation_for(context.split, test),
            "n_cells": context.cells,
            "seed": context.seed,
        }
        localizer = LOCALIZERS[self.localizer](**options)
        began = time.perf_counter()
        localizer.fit(train)
        fitted = time.perf_counter()
        located = localizer.locate(test.rssi_dbm)
        seconds = {"fit": fitted - began, "predict": time.perf_counter() - fitted}
        value: Row = {
            "n_train": len(train),
            "n_receivers": len(train.receiver_names),
            "seconds": seconds,
            "index": test.index,
            "truth": test.transmitter_position,
            "estimate": located.position,
        }
        if located.radius is not None and located.ambiguous is not None:
            value |= {"radius": located.radius, "ambiguous": located.ambiguous}
        if isinstance(localizer, PosteriorLocalizer) and self.is_whole:
            locator = localizer.locator
            value["weights"] = dict(zip(("values", "detections", "fingerprints"), locator.weight.tolist(), strict=True))
            locator.save(folder / LOCATOR)
            error = (located.position - test.transmitter_position).norm(dim=1)
            write_npz(folder / MAPS, posterior_maps(locator, train, test, error))
            if context.suggest:
                write_suggestion(folder, locator, train, context)
        return value


def write_suggestion(folder: Path, locator: RssiLocator, train: Rssi, context: Experiment) -> None:
    """Write the positions where a measurement reduces the position error most, as a table and for the report."""
    found = suggest_positions(locator, train, context.suggest, context.seed)
    columns = dict(zip(("x_m", "y_m", "z_m"), found.position.T.tolist(), strict=True))
    columns |= degree_columns(train.origin, found.position.numpy())
    columns["variance_left"] = found.variance[1:].tolist()
    write_table(
        folder / f"{SUGGESTED}.csv",
        [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)],
    )
    arrays = {"measured": train.transmitter_position, "suggested": found.position, "left": found.variance}
    write_npz(folder / f"{SUGGESTED}.npz", {name: value.numpy() for name, value in arrays.items()})


def posterior_maps(locator: RssiLocator, train: Rssi, test: Rssi, error: Tensor) -> dict[str, Any]:
    """Return the posteriors in plan of six test rows, from the smallest error (n,) [m] to the largest."""
    shown = error.argsort()[torch.linspace(0, len(error) - 1, min(N_MAPS, len(error))).round().long()]
    posterior = locator.locate(test.rssi_dbm[shown])
    plans = [posterior.in_plan(row) for row in range(len(posterior))]
    return {
        "x": plans[0].x,
        "y": plans[0].y,
        "density": np.stack([plan.values for plan in plans]).astype(np.float32),
        "index": test.index[shown].numpy(),
        "truth": test.transmitter_position[shown].numpy(),
        "estimate": posterior.median.numpy(),
        "radius_80_m": posterior.credible_radius(0.8).numpy(),
        "training_position": train.transmitter_position.numpy(),
    }
