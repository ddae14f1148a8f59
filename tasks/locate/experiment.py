"""Localization measured: the posterior over positions against the baselines, on the same split of measured RSSI."""

from __future__ import annotations

from pathlib import Path

from augment.suggest import suggest_positions
from swiftwrf import Rssi, rssi_room
from swiftwrf.contrib.comparison.locating import compare
from swiftwrf.data.coordinates import degree_columns
from swiftwrf.data.formats import RSSI_FORMATS
from tasks.configs import LocateConfig
from tasks.directory import Run
from tasks.environment import choose_device
from tasks.locate.page import SUGGESTED, page
from tasks.page.page import finish
from tasks.page.shared import write_suggestion
from tasks.source import reading
from tasks.terminal import console, terminal
from tasks.workers import connected, workers_of


def run(config: LocateConfig, resume: Path | None = None) -> None:
    """Run the experiment and write its directory.

    Raises:
        InputError: Data or options that do not exist or do not fit together.
    """
    device = choose_device("cpu")
    data, reference = measurements(config)
    for note in data.notes:
        console.print(f"{data.name}: {note}")
    label = f"rx{'_'.join(config.receivers)}-s{config.seed}"
    described = "{median:.2f} m".format_map
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
                reference=reference,
                keep=directory,
                executor=workers,
            )
        train = result.train
        if result.n_undetected:
            console.print(f"{data.name}: test rows that no receiver detected are left out: {result.n_undetected}")
        if train.offsets is not None:
            console.print(f"{data.name}: {train.offsets.note()}")
        if config.suggest and result.locator is not None:
            found = suggest_positions(result.locator, train, config.suggest, config.seed)
            degrees = degree_columns(train.origin, found.position.numpy())
            measured = train.transmitter_position
            write_suggestion(directory.path(SUGGESTED), measured, found.position, found.variance, degrees)
        finish(directory, result.recorded(), page)


def measurements(config: LocateConfig) -> tuple[Rssi, str | None]:
    """Return the RSSI of a run at the receivers that are asked for, and the reference of its groups.

    Raises:
        InputError: The data cannot be read, or have no such receiver.
    """
    how = None if config.data is None else reading(config, config.data)
    data: Rssi = rssi_room(seed=config.seed) if how is None else how.read(RSSI_FORMATS)
    return data.receivers(config.receivers), how.reference if how else None
