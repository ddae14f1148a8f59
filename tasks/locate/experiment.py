"""Localization measured: the posterior over positions against the baselines, on the same split of measured RSSI."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.suggest import suggest_positions
from swiftwrf import Rssi, rssi_room
from swiftwrf.data.coordinates import degree_columns
from swiftwrf.locate import RssiLocator
from swiftwrf.locate.baselines import PosteriorLocalizer
from swiftwrf.locate.comparison import LocateComparison, LocateSplit, Trial
from swiftwrf.runtime.durable import write_npz
from swiftwrf.runtime.steps import Step
from tasks.configs import LocateConfig
from tasks.directory import Run
from tasks.environment import choose_device
from tasks.locate.page import SUGGESTED, answer, page
from tasks.page.page import finish
from tasks.page.shared import write_suggestion
from tasks.records import LOCATOR, Row, write_table
from tasks.source import measured_rssi, split_notes
from tasks.steps import run_steps
from tasks.terminal import console, terminal
from tasks.workers import connected

N_MAPS = 6  # test rows with a posterior map


@dataclass(frozen=True)
class Localization(Step[LocateSplit]):
    """Fit the localizer of a trial and locate the test rows; suggest a number of positions for the next measurements."""

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
            write_npz(folder / "maps.npz", posterior_maps(locator, context.train, context.test, error))
            if self.suggest:
                found = suggest_positions(locator, context.train, self.suggest, context.seed)
                degrees = degree_columns(context.train.origin, found.position.numpy())
                measured = context.train.transmitter_position
                write_suggestion(folder / SUGGESTED, measured, found.position, found.variance, degrees)
        return values


def run(config: LocateConfig, resume: Path | None = None) -> None:
    """Run the experiment and write its directory.

    Raises:
        InputError: Data or options that do not exist or do not fit together.
    """
    device = choose_device("cpu")
    data = measurements(config)
    for note in data.notes:
        console.print(f"{data.name}: {note}")
    measured = LocateSplit.of(data, config.split, config.cells, config.seed, config.table.reference)
    if measured.n_undetected:
        console.print(f"{data.name}: test rows that no receiver detected are left out: {measured.n_undetected}")
    if measured.train.offsets is not None:
        console.print(f"{data.name}: {measured.train.offsets.note()}")
    label = f"rx{'_'.join(config.rx)}-s{config.seed}"
    with (
        connected(config.scheduler, device) as cluster,
        Run("locate", config.out, label, config, device, data.source, resume) as directory,
    ):
        steps, values = (Localization(trial, config.suggest) for trial in measured.trials()), {}
        with terminal.progress():
            for step, value in run_steps(
                directory, steps, measured, cluster, lambda _, value: f"{value['median_m']:.2f} m"
            ):
                assert isinstance(step, Localization)
                values[step.trial] = value
        result = LocateComparison(measured, values)
        write_table(directory.path("errors.csv"), result.errors.to_dict("records"))
        finish(directory, _metrics(data, result), page, answer)


def measurements(config: LocateConfig) -> Rssi:
    """Return the RSSI of a run at the receivers that are asked for.

    Raises:
        InputError: The data cannot be read, or have no such receiver.
    """
    measured = measured_rssi(config.data, config.table)
    return (rssi_room(seed=config.seed) if measured is None else measured).receivers(config.rx)


def _metrics(data: Rssi, result: LocateComparison) -> Row:
    """Return the content of metrics.json."""
    split = result.split
    train, offsets = split.train, split.train.offsets
    return {
        "task": "locate",
        "data": data.name,
        "notes": [
            *split_notes(train, split.test, split.split),
            *data.notes,
            *([offsets.note()] if offsets else []),
        ],
        "split": split.split,
        "seed": split.seed,
        "n_train": len(train),
        "n_test": len(split.test),
        "n_receivers": len(train.receiver_names),
        "n_undetected": split.n_undetected,
        "overall": result.overall,
        "calibration": {str(level): fraction for level, fraction in result.coverage.items()},
        "weights": result.values[Trial("posterior")]["weights"],
        "by_rows": _studies(result, "rows"),
        "by_receivers": _studies(result, "receivers"),
    }


def _studies(result: LocateComparison, by: str) -> list[Row]:
    return [
        {
            "localizer": trial.localizer,
            "n_train": result.values[trial]["n_train"],
            "n_receivers": result.values[trial]["n_receivers"],
            "position_error_m": error,
        }
        for trial, error in result.studied(by)
    ]


def posterior_maps(locator: RssiLocator, train: Rssi, test: Rssi, error: Tensor) -> dict[str, Any]:
    """Return the posteriors in plan of at most six test rows, from the smallest error (n,) [m] to the largest."""
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
