"""Localization measured: the posterior over positions against the baselines, on the same split of measured RSSI."""

from __future__ import annotations

from pathlib import Path

from swiftwrf import Rssi, rssi_room
from swiftwrf.locate.comparison import LocateComparison, LocateSplit, Trial
from tasks.configs import LocateConfig
from tasks.directory import Run
from tasks.environment import choose_device
from tasks.locate.page import page
from tasks.locate.page.summary import answer
from tasks.locate.steps import Localization
from tasks.metrics import LocateMetrics, StudyMetrics
from tasks.page.page import reporting
from tasks.page.records import Records
from tasks.source import measured_rssi, split_notes
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
    measured = LocateSplit.of(data, config.split, config.cells, config.seed, config.table.reference)
    if measured.n_undetected:
        console.print(f"{data.name}: test rows that no receiver detected are left out: {measured.n_undetected}")
    if measured.train.offsets is not None:
        console.print(f"{data.name}: {measured.train.offsets.note()}")
    label = f"rx{'_'.join(config.rx)}-s{config.seed}"
    with (
        connected(config.scheduler, device) as cluster,
        Run("locate", config.out, label, config, device, data.source, resume) as directory,
    ):
        steps, values = (Localization(trial, config.suggest) for trial in measured.trials()), {}
        with terminal.progress():
            for step, value in run_steps(
                directory, steps, measured, cluster, lambda _, value: f"{value['median_m']:.2f} m"
            ):
                assert isinstance(step, Localization)
                values[step.trial] = value
        result = LocateComparison(measured, values)
        directory.write_csv("errors.csv", result.errors.to_dict("records"))
        final = directory.finish(_metrics(data, result), reporting(page))
    terminal.answer(answer(Records(final)), final / "report.html")


def measurements(config: LocateConfig) -> Rssi:
    """Return the RSSI of a run at the receivers that are asked for.

    Raises:
        InputError: The data cannot be read, or have no such receiver.
    """
    measured = measured_rssi(config.data, config.table)
    return (rssi_room(seed=config.seed) if measured is None else measured).receivers(config.rx)


def _metrics(data: Rssi, result: LocateComparison) -> LocateMetrics:
    """Return the content of metrics.json."""
    split = result.split
    train, offsets = split.train, split.train.offsets
    return {
        "task": "locate",
        "data": data.name,
        "notes": [
            *split_notes(train, split.test, split.split),
            *data.notes,
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


def _studies(result: LocateComparison, by: str) -> list[StudyMetrics]:
    return [
        {
            "localizer": trial.localizer,
            "n_train": result.values[trial]["n_train"],
            "n_receivers": result.values[trial]["n_receivers"],
            "position_error_m": error,
        }
        for trial, error in result.studied(by)
    ]
