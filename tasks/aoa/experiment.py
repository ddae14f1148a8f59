"""Turbo learning measured: one network trained on few measured spectra, on these and synthetic ones, and on all."""

from __future__ import annotations

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
from swiftwrf.data.formats.stations import station_names
from swiftwrf.errors import listed
from swiftwrf.metrics import angle_errors
from swiftwrf.models import FieldModel
from tasks.aoa.page import page
from tasks.configs import AoaConfig
from tasks.directory import Run
from tasks.environment import choose_device
from tasks.page.page import finish
from tasks.page.shared import write_suggestion
from tasks.records import Row
from tasks.source import reading
from tasks.terminal import console, terminal
from tasks.workers import connected, workers_of


def run(config: AoaConfig, resume: Path | None = None) -> None:
    """Run the experiment and write its directory, or continue an interrupted run.

    Raises:
        InputError: Data or options that do not exist or do not fit together.
        FitError: A fit diverged, or the connection to the cluster was lost.
    """
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
        Run("aoa", label, config, device, source, resume, 1 if cluster else config.processes, described) as run,
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


def measurements(config: AoaConfig) -> Spectra:
    """Return the spectra of a run.

    Raises:
        InputError: The data cannot be read, or are those of several stations.
    """
    if config.data is None:
        return simulated_room(seed=config.seed, moving=config.moving or "transmitter")
    how = reading(config, config.data)
    folder = Path(how.source)
    if how.options.station is None and len(names := station_names(folder, how.options)) > 1:
        one = f"--data {folder / names[0]}" if (folder / names[0]).is_dir() else "station: 1 in a file for --read"
        raise InputError(
            f"{folder} has several stations ({listed(names)}); swiftwrf locate --data {folder} estimates positions, and "
            f"directions at each, by all of them. For one station give {one}"
        )
    return how.spectra()
