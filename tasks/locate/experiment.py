"""Localization measured: the posterior over positions against the baselines, on the same split of measured RSSI."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from augment.suggest import suggest_positions
from swiftwrf import Rssi, rssi_room
from swiftwrf.contrib.comparison.locating import LocateComparison, compare
from swiftwrf.data.coordinates import degree_columns
from swiftwrf.runtime.durable import write_npz
from tasks.configs import LocateConfig
from tasks.directory import Run
from tasks.environment import choose_device
from tasks.locate.page import OWN, SUGGESTED, answer, page
from tasks.page.page import finish
from tasks.page.shared import write_suggestion
from tasks.records import Row, write_table
from tasks.source import measured_rssi, split_notes
from tasks.terminal import console, terminal
from tasks.workers import connected, workers_of

MAPS = "maps.npz"  # posteriors of some test rows
N_MAPS = 6  # test rows with a posterior map


def run(config: LocateConfig, resume: Path | None = None) -> None:
    """Run the experiment and write its directory.

    Raises:
        InputError: Data or options that do not exist or do not fit together.
    """
    device = choose_device("cpu")
    data = measurements(config)
    for note in data.notes:
        console.print(f"{data.name}: {note}")
    label = f"rx{'_'.join(config.rx)}-s{config.seed}"
    described = "{median_m:.2f} m".format_map
    with (
        connected(config.scheduler, device) as cluster,
        Run("locate", label, config, device, data.source, resume, described=described) as directory,
    ):
        with workers_of(directory, cluster) as workers, terminal.progress():
            result = compare(
                data,
                split=config.split,
                seed=config.seed,
                n_cells=config.cells,
                reference=config.table.reference,
                keep=directory,
                executor=workers,
            )
        split, train = result.split, result.split.train
        if split.n_undetected:
            console.print(f"{data.name}: test rows that no receiver detected are left out: {split.n_undetected}")
        if train.offsets is not None:
            console.print(f"{data.name}: {train.offsets.note()}")
        if config.suggest and result.locator is not None:
            found = suggest_positions(result.locator, train, config.suggest, split.seed)
            degrees = degree_columns(train.origin, found.position.numpy())
            measured = train.transmitter_position
            write_suggestion(directory.path(SUGGESTED), measured, found.position, found.variance, degrees)
        finish(directory, record(result, directory.folder), page, answer)


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
    write_npz(folder / MAPS, posterior_maps(result))
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
        "weights": result.values[OWN]["weights"],
        "held_out": result.values[OWN].get("held_out", {}),
    }


def posterior_maps(result: LocateComparison) -> dict[str, Any]:
    """Return the posteriors in plan of at most six test rows, from the smallest error to the largest."""
    assert result.locator is not None
    test, errors = result.split.test, result.errors
    order = errors.loc[errors["method"] == OWN, "position_error_m"].to_numpy().argsort()
    shown = order[np.linspace(0, len(order) - 1, min(N_MAPS, len(order))).round().astype(int)]
    posterior = result.locator.locate(test.rssi_dbm[shown])
    plans = [posterior.in_plan(row) for row in range(len(posterior))]
    return {
        "x": plans[0].x,
        "y": plans[0].y,
        "density": np.stack([plan.values for plan in plans]).astype(np.float32),
        "index": test.index[shown].numpy(),
        "truth": test.transmitter_position[shown].numpy(),
        "estimate": posterior.median.numpy(),
        "radius_80_m": posterior.credible_radius(0.8).numpy(),
        "training_position": result.split.train.transmitter_position.numpy(),
    }
