"""Localization measured: the posterior over positions against the baselines, on the same split of measured RSSI."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from augment.suggest import suggest_positions
from swiftwrf import Rssi, rssi_room
from swiftwrf.data.coordinates import degree_columns
from swiftwrf.locate import RssiLocator
from swiftwrf.locate.baselines import PosteriorLocalizer
from swiftwrf.locate.comparison import LocateComparison, LocateSplit, Trial
from swiftwrf.runtime.durable import write_npz
from swiftwrf.runtime.steps import Steps
from tasks.configs import LocateConfig
from tasks.directory import Run
from tasks.environment import choose_device
from tasks.locate.page import SUGGESTED, answer, page
from tasks.page.page import finish
from tasks.page.shared import write_suggestion
from tasks.records import LOCATOR, Row, write_table
from tasks.source import measured_rssi, split_notes
from tasks.terminal import console, terminal
from tasks.workers import connected, workers_of

MAPS = "maps.npz"  # posteriors of some test rows
N_MAPS = 6  # test rows with a posterior map


def localize(split: LocateSplit, folder: Path, trial: Trial, suggest: int) -> Row:
    """Fit the localizer of a trial and locate the test rows; suggest a number of positions for the next measurements."""
    localizer, values = split.fit(trial)
    if isinstance(localizer, PosteriorLocalizer) and trial.is_whole:
        locator = localizer.locator
        locator.save(folder / LOCATOR)
        write_npz(folder / MAPS, posterior_maps(locator, split, values))
        if suggest:
            found = suggest_positions(locator, split.train, suggest, split.seed)
            degrees = degree_columns(split.train.origin, found.position.numpy())
            measured = split.train.transmitter_position
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
        Run("locate", config.out, label, config, device, data.source, resume, described=_described) as directory,
    ):
        with workers_of(directory, cluster) as workers, terminal.progress():
            steps = Steps(measured, directory, workers)
            started = {
                trial: steps.start(trial.name, trial.title, localize, trial, config.suggest)
                for trial in measured.trials()
            }
            values = {trial: steps[name] for trial, name in started.items()}
        finish(directory, record(LocateComparison(measured, values), directory.folder), page, answer)


def _described(value: Row) -> str:
    return f"{value['median_m']:.2f} m"


def measurements(config: LocateConfig) -> Rssi:
    """Return the RSSI of a run at the receivers that are asked for.

    Raises:
        InputError: The data cannot be read, or have no such receiver.
    """
    measured = measured_rssi(config.data, config.table)
    return (rssi_room(seed=config.seed) if measured is None else measured).receivers(config.rx)


def record(result: LocateComparison, folder: Path) -> Row:
    """Write the table and maps of a result into a folder, and return the content of metrics.json."""
    split = result.split
    train, offsets = split.train, split.train.offsets
    write_table(folder / "errors.csv", result.errors.to_dict("records"))
    if result.locator is not None:  # the step that fitted it in a run has written them
        write_npz(folder / MAPS, posterior_maps(result.locator, split, result.values[Trial("posterior")]))
    return {
        "task": "locate",
        "data": train.name,
        "notes": [
            *split_notes(train, split.test, split.split),
            *train.notes,
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


def posterior_maps(locator: RssiLocator, split: LocateSplit, values: Row) -> dict[str, Any]:
    """Return the posteriors in plan of at most six test rows, from the smallest error to the largest.

    Args:
        locator: Locator of all training rows.
        split: Training and test rows.
        values: What `LocateSplit.fit` gave for it.
    """
    test, error = split.test, (values["estimate"] - values["truth"]).norm(dim=1)
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
        "training_position": split.train.transmitter_position.numpy(),
    }
