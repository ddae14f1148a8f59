"""Turbo learning measured: one network trained on few measured spectra, on these and synthetic ones, and on all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from augment import suggest
from augment.choices import fraction_key
from augment.turbo.experiment import Experiment
from augment.turbo.learning import learn
from swiftwrf import InputError, Spectra, make_model, simulated_room
from swiftwrf.contrib.raytraced import sionna
from swiftwrf.contrib.raytraced.names import RAYTRACE
from swiftwrf.data.files import sha256
from swiftwrf.data.formats.stations import read_stations, station_names
from swiftwrf.metrics import angle_errors
from swiftwrf.models import FieldModel
from swiftwrf.runtime.durable import strict
from tasks.aoa.page import page
from tasks.aoa.stations import sentence, triangulation
from tasks.configs import AoaConfig
from tasks.directory import Run, new_directory
from tasks.environment import choose_device, stamp
from tasks.options import by_name
from tasks.page.page import REPORT, finish, write_page
from tasks.page.shared import write_suggestion
from tasks.records import CONFIG, Records, Row, read_json
from tasks.source import reading
from tasks.terminal import console, terminal
from tasks.workers import connected, workers_of


def run(config: AoaConfig, resume: Path | None = None) -> None:
    """Run the experiment and write its directory, or continue an interrupted run.

    Raises:
        InputError: Data or options that do not exist or do not fit together.
        FitError: A fit diverged, or the connection to the cluster was lost.
    """
    if config.station is None and len(names := stations_of(config)) > 1:
        run_each(config, names)
        return
    device = choose_device(config.device)
    models, source = list[str | FieldModel](config.models), {}
    if RAYTRACE in models:
        sionna()  # refuses before anything is computed
        if config.scene is not None:
            scene = make_model(RAYTRACE, seed=config.seed, scene=config.scene)
            models[models.index(RAYTRACE)] = scene
            if Path(config.scene).is_file():
                source = {f"scene {Path(config.scene).name}": sha256(Path(config.scene))}
    data = measurements(config)
    for note in data.notes:
        console.print(f"{data.name}: {note}")
    train, test = data.split(config.split, config.seed)
    experiment = Experiment(
        train,
        test,
        config.measured,
        models,
        config.only or None,
        extra=config.extra,
        preset=config.preset,
        repeats=config.repeats,
        seed=config.seed,
        device=device,
        split=config.split,
    )
    label = f"mix{'_'.join(map(fraction_key, config.measured))}-s{config.seed}"

    def described(value: Row) -> str:
        if "estimate" not in value:
            return ""
        error = angle_errors(torch.tensor(value["estimate"], dtype=torch.float64), test.label)["great_circle"]
        return f"{float(error.nanquantile(0.5).rad2deg()):.2f} degrees"

    source |= data.source
    with (
        connected(config.scheduler, device) as cluster,
        Run("aoa", label, config, device, source, resume, config.own_processes, described) as run,
    ):
        with workers_of(run, cluster) as workers, terminal.progress():
            results = learn(experiment, run, workers)
        for sentence in dict.fromkeys(sentence for result in results for sentence in result.left_out):
            console.print(sentence)
        for subset in experiment.subsets[: len(config.measured)] if config.suggest else ():
            measured, _ = experiment.withhold(subset)
            found = suggest(measured, config.suggest, config.seed)
            write_suggestion(run.path(f"suggested-mix{subset.key}"), measured.position, found.position, found.variance)
        finish(run, results[0].recorded(*results[1:]), page)


def run_each(config: AoaConfig, names: Sequence[str]) -> None:
    """Run the experiment at each station of the data, and write one report over all.

    The runs are folders of `config.out` with the names of the stations. Those that are finished are kept.

    Raises:
        InputError: A run of other options, an interrupted run, or a report.
    """
    folder = Path(config.out) if config.out else Path("runs") / "aoa" / f"{stamp()}-stations"
    runs = {name: replace(config, station=name, out=str(folder / name)) for name in names}
    for name, one in runs.items():
        if not (folder / name).exists():
            console.print(f"station {name}")
            run(one)
        elif read_json(folder / name / CONFIG)["config"] != strict(by_name(one)):
            raise InputError(f"{folder / name} is a run of other options; choose another --out")
    of_stations = [Records(folder / name, number=number) for number, name in enumerate(names, start=1)]
    with new_directory(folder / "report", "a report") as unfinished:
        write_page(unfinished, page(of_stations))
    how = reading(config, str(config.data))
    train, test = read_stations(Path(how.source), how.options).split(config.split, config.seed)
    found = triangulation(train, test, dict(zip(names, of_stations, strict=True)))
    text = f"{sentence(found, len(names))} swiftwrf locate --data {config.data} locates by all spectra together."
    terminal.page({"triangulation": found}, text, folder / "report" / REPORT)


def stations_of(config: AoaConfig) -> list[str]:
    """Return the names of the stations in the data, none in data of one."""
    if config.data is None:
        return []
    how = reading(config, config.data)
    return [] if how.options.station is not None else station_names(Path(how.source), how.options)


def measurements(config: AoaConfig) -> Spectra:
    """Return the spectra of a run; stations have the same split.

    Raises:
        InputError: The data cannot be read, or lack the station or the split.
    """
    if config.data is None:
        return simulated_room(seed=config.seed, moving=config.moving or "transmitter")
    how = reading(config, config.data)
    if config.station is None:
        return how.spectra()
    stations = read_stations(Path(how.source), how.options)
    spectra = stations.of(config.station)[1]
    train, test = (
        torch.isin(spectra.index, part.index).nonzero()[:, 0] for part in stations.split(config.split, config.seed)
    )
    return spectra.derived(name=f"{config.station} of {stations.name}", named_splits={config.split: (train, test)})
