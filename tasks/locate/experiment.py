"""Localization measured: the posterior over positions against the baselines, on the same split of measured RSSI."""

from __future__ import annotations

from pathlib import Path

from augment.placement import suggest_station
from augment.suggest import suggest_positions
from swiftwrf import InputError, Rssi, Stations, rssi_room, simulated_stations
from swiftwrf.contrib.comparison.locating import LocateComparison, PositionComparison, compare
from swiftwrf.contrib.comparison.stations import StationsComparison, compare_stations
from swiftwrf.data.coordinates import degree_columns
from swiftwrf.data.formats import RSSI_FORMATS
from swiftwrf.data.formats.stations import read_stations, station_names
from tasks.configs import LocateConfig
from tasks.directory import Run
from tasks.environment import choose_device
from tasks.locate.page import page
from tasks.locate.placement import write_poses
from tasks.page.maps import FloorPlan
from tasks.page.page import finish
from tasks.page.receivers import with_receivers
from tasks.page.shared import write_suggestion
from tasks.records import SUGGESTED, Row
from tasks.source import reading, rooms_beside
from tasks.terminal import console, terminal
from tasks.workers import connected, workers_of


def run(config: LocateConfig, resume: Path | None = None) -> None:
    """Run the experiment and write its directory.

    Raises:
        InputError: Data or options that do not exist or do not fit together.
    """
    device = choose_device("cpu")
    data, reference = measurements(config)
    rooms = None
    if isinstance(data, Stations):
        config.check_stations()
    else:
        data.check_power("a locator")
        how = None if config.data is None else reading(config, config.data)
        rooms = rooms_beside(how, config.rooms, data.origin, data.floors)
    plan = FloorPlan.stated(config, data.name, getattr(data, "plan_scale", None))
    source = data.source | (rooms.source if rooms else {}) | (plan.source if plan else {})
    for note in data.notes:
        console.print(f"{data.name}: {note}")
    label = f"{'stations' if isinstance(data, Stations) else 'rx' + '_'.join(config.receivers)}-s{config.seed}"
    with (
        connected(config.scheduler, device) as cluster,
        Run("locate", label, config, device, source, resume, config.own_processes, _described) as directory,
    ):
        with workers_of(directory, cluster) as workers, terminal.progress():
            common: Row = {"split": config.split, "seed": config.seed, "keep": directory, "executor": workers}
            if isinstance(data, Stations):
                result: PositionComparison = compare_stations(data, **common)
            else:
                result = compare(data, n_cells=config.cells, reference=reference, rooms=rooms, **common)
        if plan is not None:
            plan.save(directory.folder)
        if isinstance(result, LocateComparison):
            _conclude(result, config, directory)
        elif isinstance(result, StationsComparison):
            _place(result, config, directory)
        train, recorded = result.train, result.recorded()
        finish(directory, with_receivers(recorded, train) if isinstance(train, Rssi) else recorded, page)


def _described(values: Row) -> str:
    """Return the result of a step in a few words."""
    return f"{values['median']:.2f} m" if "median" in values else str(values.get("conclusion", ""))


def _conclude(result: LocateComparison, config: LocateConfig, directory: Run) -> None:
    """Print what was left out and removed, and write the positions to measure next."""
    train = result.train
    if result.n_undetected:
        console.print(f"{train.name}: test rows that no receiver detected are left out: {result.n_undetected}")
    if train.offsets is not None:
        console.print(f"{train.name}: {train.offsets.note()}")
    if config.suggest and result.locator is not None:
        found = suggest_positions(result.locator, train, config.suggest, config.seed)
        degrees = degree_columns(train.origin, found.position.numpy())
        measured = train.transmitter_position
        write_suggestion(directory.path(SUGGESTED), measured, found.position, found.variance, degrees)


def _place(result: StationsComparison, config: LocateConfig, directory: Run) -> None:
    """Write the poses of a next array that lower the position error most, and print the best."""
    if not config.suggest or result.locator is None:
        return
    try:
        found = suggest_station(result.locator, config.suggest, seed=config.seed)
    except InputError as error:
        console.print(f"no pose of a next array: {error}")
        return
    write_poses(directory.path(SUGGESTED), result.train.position, found)
    best, normal = found.pose[0], found.normal[0].tolist()
    console.print(
        f"a next array at ({', '.join(f'{x:.2f}' for x in best.position)}) m, facing "
        f"({', '.join(f'{x:.2f}' for x in normal)}), would lower the expected median error by "
        f"{float(found.gain_m[0]):.3f} m (+- {float(found.gain_std_m[0]):.3f}) from {found.before_m:.3f} m"
    )


def measurements(config: LocateConfig) -> tuple[Rssi | Stations, str | None]:
    """Return the RSSI of a run at the receivers that are asked for, or the spectra of several stations.

    Returns:
        Measurements, and the reference of the groups of RSSI.

    Raises:
        InputError: The data cannot be read, or have no such receiver.
    """
    if config.stations:
        return simulated_stations(stations=config.stations, seed=config.seed), None
    how = None if config.data is None else reading(config, config.data)
    if how is not None and station_names(Path(how.source), how.options):
        return read_stations(Path(how.source), how.options), None
    data: Rssi = rssi_room(seed=config.seed) if how is None else how.read(RSSI_FORMATS)
    return data.receivers(config.receivers), how.reference if how else None
