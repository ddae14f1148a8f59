"""Localization measured: the posterior over positions against the baselines, on the same split of measured RSSI."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from swiftwrf import InputError, Rssi, rssi_room
from swiftwrf.data.coordinates import degree_columns
from swiftwrf.locate.baselines import LEVELS
from swiftwrf.metrics import summary
from tasks.locate.options import LocateConfig
from tasks.locate.page import page
from tasks.locate.page.summary import answer
from tasks.locate.steps import MIN_ROWS, Experiment, Localization
from tasks.metrics import LocateMetrics, StudyMetrics
from tasks.page.page import reporting
from tasks.page.records import Records
from tasks.run import Row, Run, choose_device
from tasks.source import asked_offsets, measured_rssi, split_notes
from tasks.steps import run_steps
from tasks.terminal import console, terminal
from tasks.workers import connected


def run(config: LocateConfig, resume: Path | None = None) -> None:
    """Run the experiment and write its directory.

    Raises:
        InputError: Data or options that do not exist or do not fit together.
    """
    device = choose_device("cpu")
    data = measurements(config)
    for note in data.notes:
        console.print(f"{data.name}: {note}")
    experiment, n_undetected = prepared(data, config.split, config.cells, config.seed, config.suggest)
    if n_undetected:
        console.print(f"{data.name}: test rows that no receiver detected are left out: {n_undetected}")
    if (offsets := asked_offsets(experiment.train, config)) is not None:
        train, test = offsets.removed(experiment.train), offsets.removed(experiment.test)
        experiment = replace(experiment, train=train, test=test)
        console.print(f"{data.name}: {offsets.note()}")
    label = f"rx{'_'.join(config.rx)}-s{config.seed}"
    with (
        connected(config.scheduler, device) as cluster,
        Run("locate", config.out, label, config, device, data.source, resume) as directory,
    ):
        results = Results(experiment)
        with terminal.progress():
            for step, value in run_steps(directory, experiment.steps(), experiment, cluster):
                assert isinstance(step, Localization)
                results.add(step, value)
                terminal.result(step.title, f"{results.median_m(step):.2f} m")
        directory.write_csv("errors.csv", results.errors)
        final = directory.finish(results.metrics(data, n_undetected), reporting(page))
    terminal.answer(answer(Records(final)), final / "report.html")


def measurements(config: LocateConfig) -> Rssi:
    """Return the RSSI of a run at the receivers that are asked for.

    Raises:
        InputError: The data cannot be read, or have no such receiver.
    """
    measured = measured_rssi(config.data, config)
    if measured is not None and measured.receiver_moves:
        raise InputError(
            f"both ends of {measured.name} move; positions are found by receivers that stay where they are"
        )
    return (rssi_room(seed=config.seed) if measured is None else measured).receivers(config.rx)


def prepared(data: Rssi, split: str, cells: int, seed: int, suggest: int = 0) -> tuple[Experiment, int]:
    """Return the experiment on a split, and the number of its test rows that no receiver detected, which it omits.

    Raises:
        InputError: No such split, or too few rows in which a receiver detected the transmitter.
    """
    train, test = data.split(split, seed)
    detected = int(train.detected.any(dim=1).sum())
    if detected < MIN_ROWS:
        raise InputError(
            f"split {split!r} of {data.name} has {detected} training rows that a receiver detected; at least {MIN_ROWS} are "
            "needed to locate by"
        )
    kept = test.detected.any(dim=1)
    if not bool(kept.any()):
        raise InputError(f"split {split!r} of {data.name} has no test rows that a receiver detected")
    return Experiment(train, test.subset(kept), split, cells, seed, suggest), int((~kept).sum())


class Results:
    """Tables and metrics of a run, collected step by step.

    Args:
        experiment: Data and options of the run.
    """

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self.errors: list[Row] = []
        self._overall: Row = {}
        self._studies: list[tuple[Localization, StudyMetrics]] = []
        self._coverage: dict[str, float] = {}
        self._weights: dict[str, float] = {}

    def add(self, step: Localization, value: Row) -> None:
        """Add the result of a step."""
        truth, estimate = (torch.tensor(value[name], dtype=torch.float64) for name in ("truth", "estimate"))
        away = estimate - truth
        error, horizontal = away.norm(dim=1), away[:, :2].norm(dim=1)
        study: StudyMetrics = {
            "localizer": step.localizer,
            "n_train": value["n_train"],
            "n_receivers": value["n_receivers"],
            "position_error_m": summary(error),
        }
        self._studies.append((step, study))
        if not step.is_whole:
            return
        columns: Row = {"position_error_m": error, "horizontal_error_m": horizontal}
        columns |= dict(zip(("x_m", "y_m", "z_m"), estimate.T, strict=True))
        columns |= dict(zip(("truth_x_m", "truth_y_m", "truth_z_m"), truth.T, strict=True))
        degrees = degree_columns(self.experiment.train.origin, estimate.numpy())
        columns |= {name: torch.from_numpy(values.copy()) for name, values in degrees.items()}
        if "radius" in value:
            radius = torch.tensor(value["radius"], dtype=torch.float64)
            columns |= {f"credible_radius_{100 * p:.0f}_m": r for p, r in zip(LEVELS, radius.T, strict=True)}
            columns["ambiguous"] = torch.tensor(value["ambiguous"])
        if step.localizer == "posterior":
            inside = (error[:, None] <= radius).double().mean(dim=0)
            self._coverage = {str(level): float(c) for level, c in zip(LEVELS, inside, strict=True)}
            self._weights = value["weights"]
        cells = zip(value["index"], *(column.tolist() for column in columns.values()), strict=True)
        self.errors += [{"method": step.localizer} | dict(zip(("index", *columns), row, strict=True)) for row in cells]
        self._overall[step.localizer] = {
            "position_error_m": summary(error),
            "horizontal_error_m": summary(horizontal),
            "seconds": value["seconds"],
        }

    def median_m(self, step: Localization) -> float:
        """Return the median position error of a step [m]."""
        return next(study["position_error_m"]["median"] for known, study in self._studies if known == step)

    def metrics(self, data: Rssi, n_undetected: int) -> LocateMetrics:
        """Return the content of metrics.json of a run on these data."""
        train, test = self.experiment.train, self.experiment.test
        return {
            "task": "locate",
            "data": data.name,
            "notes": [
                *split_notes(train, test, self.experiment.split),
                *data.notes,
                *([train.offsets.note()] if train.offsets else []),
            ],
            "split": self.experiment.split,
            "seed": self.experiment.seed,
            "n_train": len(train),
            "n_test": len(test),
            "n_receivers": len(train.receiver_names),
            "n_undetected": n_undetected,
            "overall": self._overall,
            "calibration": self._coverage,
            "weights": self._weights,
            "by_rows": self._studied(lambda step: step.receivers == 1),
            "by_receivers": self._studied(lambda step: step.rows == 1),
        }

    def _studied(self, belongs: Callable[[Localization], bool]) -> list[StudyMetrics]:
        """Return the study of localizers that some of these steps fit to parts of the data."""
        studies = [(step, study) for step, study in self._studies if belongs(step)]
        names = {step.localizer for step, _ in studies if not step.is_whole}
        return [study for step, study in studies if step.localizer in names]
