"""Turbo learning measured: one network trained on few measured spectra, on these and synthetic ones, and on all."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch

from augment.turbo.choice import Suggestion, first_steps
from augment.turbo.experiment import Experiment
from augment.turbo.locating import Locating
from augment.turbo.results import Results
from augment.turbo.synthesis import Evaluation, Synthesis, as_bytes
from swiftwrf import Spectra, simulated_room
from swiftwrf.choices import RAYTRACE, fraction_key
from swiftwrf.data import load_spectra
from swiftwrf.data.files import sha256
from swiftwrf.data.raytraced import sionna
from swiftwrf.metrics import angle_errors, covered
from swiftwrf.runtime.durable import write_npz
from swiftwrf.runtime.steps import Step
from tasks.aoa.page import answer_of, page
from tasks.configs import AoaConfig
from tasks.directory import Run
from tasks.environment import choose_device
from tasks.options import TableSource
from tasks.page.page import finish
from tasks.page.shared import write_suggestion
from tasks.records import Row, write_table
from tasks.source import located, reading
from tasks.steps import run_steps
from tasks.terminal import console, terminal
from tasks.workers import connected

# of the PSNR at the test positions, from the best spectrum to the worst
EXAMPLE_QUANTILES = (1.0, 0.5, 0.0)


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
    train, test = data.split(config.split, config.seed)
    experiment = Experiment(
        train,
        test,
        config.mix,
        config.synthesizer,
        extra=config.extra,
        preset=config.preset,
        repeats=config.repeats,
        seed=config.seed,
        scene=config.scene,
        suggest=config.suggest,
        device=device,
    )
    source = data.source
    if config.scene is not None and Path(config.scene).is_file():
        source = {**source, f"scene {Path(config.scene).name}": sha256(Path(config.scene))}
    label = f"mix{'_'.join(map(fraction_key, config.mix))}-s{config.seed}"
    with (
        connected(config.scheduler, device) as cluster,
        Run("aoa", config.out, label, config, device, source, resume, 1 if cluster else config.processes) as directory,
    ):
        results = Results(experiment, console.print)
        with terminal.progress():
            for step, value in run_steps(
                directory, first_steps(experiment), experiment, cluster, partial(_described, experiment)
            ):
                results.add(step, value)
                _write_files(step, value, experiment.test, directory)
        tables = {"errors": results.errors(), "synthesis": results.synthesis, "history": results.history}
        for name, rows in (tables | ({"positions": found} if (found := results.positions()) else {})).items():
            write_table(directory.path(f"{name}.csv"), rows)
        metrics: Row = {
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
        finish(directory, metrics, page, answer_of)


def measurements(config: AoaConfig) -> Spectra:
    """Return the spectra of a run.

    Raises:
        InputError: The data cannot be read.
    """
    if config.data is None:
        return simulated_room(seed=config.seed, moving=config.moving or "transmitter")
    return load_spectra(located(config.data), **reading(config.spectra, TableSource()).given)


def _described(experiment: Experiment, step: Step[Experiment], value: Row) -> str:
    """Return the median angular error of a condition in words."""
    if not isinstance(step, Evaluation | Locating) or "refused" in value:
        return ""
    error = angle_errors(torch.tensor(value["estimate"], dtype=torch.float64), experiment.test.label)["great_circle"]
    return f"{float(error.nanquantile(0.5).rad2deg()):.2f} degrees"


def _write_files(step: Step[Experiment], value: Row, test: Spectra, run: Run) -> None:
    """Write what the report shows of a step: suggested positions, or synthetic spectra of the first trained field model."""
    match step:
        case Suggestion():
            measured, position, variance = (
                torch.tensor(value[key], dtype=torch.float64) for key in ("measured", "position", "variance")
            )
            write_suggestion(run.path(f"suggested-mix{step.subset.key}"), measured, position, variance)
        case Synthesis(trains=True) if "refused" not in value and step.subset.repeat == 0:
            file = run.path(f"examples-mix{step.subset.key}.npz")
            if not file.exists():
                write_npz(file, _examples(step, torch.tensor(value["scores"]["psnr_db"]), test, run.folder))


def _examples(step: Synthesis, score: torch.Tensor, test: Spectra, folder: Path) -> Row:
    """Return measured and synthetic spectra at the test positions with given quantiles of their PSNR (n,)."""
    spectra = step.test_spectra(folder)
    measured, synthetic = test.store, spectra["test"]
    order = score.argsort()
    chosen = order[[round(q * (len(order) - 1)) for q in EXAMPLE_QUANTILES]]
    examples = {
        "measured": as_bytes(measured[chosen]).numpy(),
        "synthetic": as_bytes(synthetic[chosen]).numpy(),
        "synthesizer": step.synthesizer,
        "index": test.index[chosen].numpy(),
        "psnr_db": score[chosen].numpy(),
    }
    if "test_std" in spectra:
        std = spectra["test_std"]
        examples["deviation"] = as_bytes(std[chosen]).numpy()
        triples = zip(synthetic.batches(), measured.batches(), std.batches(), strict=True)
        examples["coverage"] = float(torch.cat([covered(s, d, m) for s, m, d in triples]).mean())
    return examples
