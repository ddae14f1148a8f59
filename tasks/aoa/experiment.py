"""Turbo learning measured: one network trained on few measured spectra, on these and synthetic ones, and on all."""

from __future__ import annotations

from pathlib import Path

from augment import withhold
from swiftwrf import InputError, Spectra, simulated_room
from swiftwrf.data import load_spectra
from swiftwrf.data.files import sha256
from swiftwrf.data.raytraced import sionna
from tasks.aoa.condition import MeasuredSubset
from tasks.aoa.context import Experiment
from tasks.aoa.options import RAYTRACE, AoaConfig, check_data, fraction_key, n_synthetic
from tasks.aoa.page import page
from tasks.aoa.page.summary import answer
from tasks.aoa.results import Results
from tasks.aoa.steps import first_steps
from tasks.aoa.suggestion import Suggestion
from tasks.metrics import AoaMetrics
from tasks.page.page import reporting
from tasks.page.records import Records
from tasks.run import Run, choose_device
from tasks.source import located, reading
from tasks.steps import Step, run_steps
from tasks.terminal import console, terminal
from tasks.workers import connected


def run(config: AoaConfig, resume: Path | None = None) -> None:
    """Run the experiment and write its directory, or continue an interrupted run.

    Raises:
        InputError: Data or options that do not exist or do not fit together.
        FitError: A fit diverged, or the connection to the cluster was lost.
    """
    device = choose_device(config.device)
    if RAYTRACE in config.synthesizer:
        sionna()  # refuses before anything is computed
    data = measurements(config)
    for note in data.notes:
        console.print(f"{data.name}: {note}")
    check_data(data, config)
    train, test = data.split(config.split, config.seed)
    if len(test) == 0:
        raise InputError(f"split {config.split!r} of {data.name} has no test spectra")
    for fraction in config.mix:
        withhold(train, fraction, config.seed)  # refuses before anything is written
    experiment = Experiment(config, train, test, n_synthetic(data, config), device)
    subsets = [MeasuredSubset(fraction, repeat) for repeat in range(config.repeats) for fraction in config.mix]
    steps: list[Step[Experiment]] = [step for subset in subsets for step in first_steps(experiment, subset)]
    if config.suggest:
        steps += [Suggestion(subset) for subset in subsets if subset.repeat == 0]
    source = data.source
    if config.scene is not None and Path(config.scene).is_file():
        source = {**source, f"scene {Path(config.scene).name}": sha256(Path(config.scene))}
    label = f"mix{'_'.join(map(fraction_key, config.mix))}-s{config.seed}"
    with (
        connected(config.scheduler, device) as cluster,
        Run("aoa", config.out, label, config, device, source, resume, 1 if cluster else config.processes) as directory,
    ):
        results = Results(experiment, directory)
        with terminal.progress():
            for step, value in run_steps(directory, steps, experiment, cluster, results.show):
                results.add(step, value)
        results.write()
        metrics: AoaMetrics = {
            "task": "aoa",
            "data": data.name,
            "split": config.split,
            "preset": config.preset,
            "seed": config.seed,
            "repeats": config.repeats,
            "moving": data.moving,
            "notes": list(data.notes),
            "extra": experiment.n_synthetic,
            "n_train": len(train),
            "n_test": len(test),
            "grid": data.grid.shape,
            "line_of_sight_share": float(test.line_of_sight.float().mean()),
            "mixes": {fraction_key(fraction): results.summary(fraction) for fraction in config.mix},
        }
        final = directory.finish(metrics, reporting(page))
    terminal.answer(answer(Records(final)), final / "report.html")


def measurements(config: AoaConfig) -> Spectra:
    """Return the spectra of a run.

    Raises:
        InputError: The data cannot be read.
    """
    if config.data is None:
        return simulated_room(seed=config.seed, moving=config.moving or "transmitter")
    return load_spectra(located(config.data), **reading(config).given)
