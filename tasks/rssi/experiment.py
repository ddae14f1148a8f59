"""RSSI of a moving transmitter at fixed receivers: SwiftWRF against the predictors that practitioners use."""

from __future__ import annotations

from pathlib import Path

from swiftwrf import Rssi, RssiModel, rssi_room
from swiftwrf.contrib.comparison.predictors import compared
from swiftwrf.contrib.comparison.rssi import RssiComparison, compare
from swiftwrf.data.coordinates import degree_columns
from swiftwrf.data.formats import RSSI_FORMATS
from swiftwrf.models.prediction import difference_unit
from tasks.configs import RssiTaskConfig
from tasks.directory import Run
from tasks.environment import choose_device
from tasks.page.maps import FloorPlan
from tasks.page.page import finish
from tasks.page.receivers import with_receivers
from tasks.page.shared import NOT_WORTH, is_worth, suggestions, write_suggestion
from tasks.records import SUGGESTED, Row
from tasks.rssi.page import page
from tasks.source import offset_notes, reading, rooms_beside
from tasks.terminal import console, terminal
from tasks.workers import connected, workers_of

FEWER = (0.125,)  # of the training rows, for the error against their number


def run(config: RssiTaskConfig, resume: Path | None = None) -> None:
    """Run the experiment and write its directory, or continue an interrupted one.

    Raises:
        InputError: A configuration that the data cannot meet or that contradicts itself.
    """
    device = choose_device("cpu" if config.device == "auto" else config.device)
    how = None if config.data is None else reading(config, config.data)
    whole: Rssi = rssi_room(seed=config.seed) if how is None else how.read(RSSI_FORMATS)
    data = whole.receivers(config.receivers)
    plan = FloorPlan.stated(config, data.name, data.plan_scale)
    rooms = rooms_beside(how, config.rooms, data.origin, data.floors)
    for note in data.notes:
        console.print(f"{data.name}: {note}")
    left_out = compared(data, config.also, config.only)[1] if data.is_power else {}  # others have no models of power
    for reason in left_out.values():
        console.print(f"left out: {reason}")
    label = f"rx{'_'.join(config.receivers)}-s{config.seed}"
    source = data.source | (rooms.source if rooms else {}) | (plan.source if plan else {})

    def described(value: Row) -> str:
        return f"{value['median']:.2f} {difference_unit(whole.unit)}" if "median" in value else ""

    with (
        connected(config.scheduler, device) as cluster,
        Run("rssi", label, config, device, source, resume, config.own_processes, described) as directory,
    ):
        with workers_of(directory, cluster) as workers, terminal.progress():
            result = compare(
                whole,
                receivers=config.receivers,
                split=config.split,
                seed=config.seed,
                also=config.also,
                only=config.only,
                preset=config.preset,
                not_detected=config.not_detected,
                validation=config.validation,
                reference=how.reference if how else None,
                fewer=FEWER,
                repeats=config.repeats,
                above=config.above,
                below=config.below,
                rooms=rooms,
                device=device,
                keep=directory,
                executor=workers,
                parallel=cluster.map if cluster else None,
                progress=True,
            )
        if result.train.offsets is not None:
            console.print(f"{data.name}: {result.train.offsets.note()}")
        if (detection := result.predictors[result.model].detection) is not None:
            console.print(f"{data.name}: {detection.note(data.receiver_names)}")
        if plan is not None:
            plan.save(directory.folder)
        recorded = with_receivers(result.recorded(), result.train)
        _suggest(result, config, directory)
        finish(directory, recorded, page, offset_notes(data))


def _suggest(result: RssiComparison, config: RssiTaskConfig, directory: Run) -> None:
    """Write the positions to measure next, and print the first ones, or that none is worth it."""
    model, train = result.predictors[result.model], result.train
    if not config.suggest or not isinstance(model, RssiModel):
        return
    from augment.suggest import suggest_scans  # loads the locator, which only suggestions need

    found = suggest_scans(model, train, config.suggest, result.thresholds[0][0], result.is_below)
    if not is_worth(found.variance.numpy()):
        console.print(NOT_WORTH)
        return
    degrees = degree_columns(train.origin, found.position.numpy())
    write_suggestion(directory.path(SUGGESTED), train.transmitter_position, found.position, found.variance, degrees)
    console.print(suggestions(found.position.numpy(), found.variance.numpy()), markup=False)
