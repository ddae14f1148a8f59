"""Steps of the experiment: a localizer is fitted to training rows, or a part of them, and locates the test rows."""

from __future__ import annotations

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
from swiftwrf.locate.baselines import PosteriorLocalizer
from swiftwrf.locate.comparison import LocateSplit, Trial
from swiftwrf.runtime.durable import write_npz
from swiftwrf.runtime.steps import Step
from tasks.records import LOCATOR, Row, write_table

MAPS = "maps.npz"
SUGGESTED = "suggested"
N_MAPS = 6  # test rows with a posterior map


@dataclass(frozen=True)
class Localization(Step[LocateSplit]):
    """Fit a localizer and locate the test rows.

    Args:
        trial: The localizer and its part of the data.
        suggest: Number of positions to suggest for the next measurements.
    """

    trial: Trial
    suggest: int = 0

    @property
    def name(self) -> str:
        return self.trial.name

    @property
    def title(self) -> str:
        rows, receivers = self.trial.rows, self.trial.receivers
        parts = [f"{rows:.0%} of the rows"] * (rows < 1) + [f"{receivers:.0%} of the receivers"] * (receivers < 1)
        return f"{self.trial.localizer}, {' and '.join(parts)}" if parts else self.trial.localizer

    def compute(self, context: LocateSplit, folder: Path) -> Row:
        localizer, values = context.fit(self.trial)
        if isinstance(localizer, PosteriorLocalizer) and self.trial.is_whole:
            locator = localizer.locator
            locator.save(folder / LOCATOR)
            error = (values["estimate"] - values["truth"]).norm(dim=1)
            write_npz(folder / MAPS, posterior_maps(locator, context.train, context.test, error))
            if self.suggest:
                write_suggestion(folder, locator, context.train, self.suggest, context.seed)
        return values


def write_suggestion(folder: Path, locator: RssiLocator, train: Rssi, number: int, seed: int) -> None:
    """Write the positions where a measurement reduces the position error most, as a table and for the report."""
    found = suggest_positions(locator, train, number, seed)
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
