"""Turbo learning measured: the same network trained on few measured spectra, on those and synthetic ones, and on all."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pandas import DataFrame
from torch import Tensor

from augment import Mixed, Places, make_synthesizer, mix, withhold
from augment import Settings as SynthesizerSettings
from swiftwrf import InputError, Spectra, load_spectra, simulated_room
from swiftwrf.checkpoint import read, write
from swiftwrf.metrics import angle_errors, l1, psnr, ssim
from tasks.aoa import (
    aann,  # noqa: F401 (registers the network)
    arms,
)
from tasks.aoa.config import AoaConfig, can_draw, check, with_array
from tasks.aoa.estimators import ESTIMATORS, Settings
from tasks.aoa.page import page
from tasks.metrics import ANGLES, SCORES, AoaMetrics, ArmMetrics, MixMetrics, SynthesisMetrics
from tasks.page.page import reporting
from tasks.run import Row, Run, choose_device, console
from tasks.summarise import averaged, repeats_averaged

SCORE = {"psnr_db": psnr, "ssim": ssim, "l1": l1}
COMPARED = ("nearest", "idw", "gp", "coarray")  # synthesizers that are always measured beside those asked for
EXAMPLE_QUANTILES = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)  # of the PSNR at the test positions: the best to the worst spectrum


def run(config: AoaConfig, resume: Path | None = None) -> None:
    """Runs the experiment and writes its directory, or goes on with an interrupted one.

    Raises:
        InputError: what the configuration asks for is not there or makes no sense.
    """
    device = choose_device(config.device)
    check(config)
    data = with_array(load_spectra(config.data) if config.data else simulated_room(seed=config.seed), config)
    train, test = data.split(config.split, config.seed)
    if len(test) == 0:
        raise InputError(f"split {config.split!r} of {data.name} has no test spectra")
    for share in config.mix:
        withhold(train, share, config.seed)  # refuses before anything is written
    label = f"mix{'_'.join(f'{share:g}' for share in config.mix)}-s{config.seed}"
    with Run("aoa", config.out, label, config, device, data.source, resume) as directory:
        experiment = _Experiment(config, train, test, device, directory)
        for repeat in range(config.repeats):
            for share in config.mix:
                experiment.turbo(share, repeat)
        directory.write_csv("errors.csv", experiment.errors)
        directory.write_csv("synthesis.csv", experiment.synthesis)
        directory.write_csv("history.csv", experiment.history)
        metrics: AoaMetrics = {
            "task": "aoa",
            "data": data.name,
            "split": config.split,
            "preset": config.preset,
            "seed": config.seed,
            "repeats": config.repeats,
            "moving": data.moving,
            "n_train": len(train),
            "n_test": len(test),
            "grid": data.grid.shape,
            "line_of_sight_share": float(test.line_of_sight.float().mean()),
            "mixes": {f"{share:g}": experiment.summary(share) for share in config.mix},
        }
        final = directory.finish(metrics, reporting(page))
    console.print(f"report: [bold]{final / 'report.html'}[/]")


class _Experiment:
    """Trains and tests every arm, each a step of the run's directory, and gathers the tables of the run."""

    def __init__(self, config: AoaConfig, train: Spectra, test: Spectra, device: torch.device, directory: Run) -> None:
        self.config, self.train, self.test, self.device, self.directory = config, train, test, device, directory
        self.errors: list[Row] = []
        self.synthesis: list[Row] = []
        self.history: list[Row] = []
        self.training_seconds: list[Row] = []
        self.synthesis_seconds: list[Row] = []

    def turbo(self, share: float, repeat: int) -> None:
        """All arms at one measured share."""
        measured, withheld = withhold(self.train, share, self.config.seed + repeat)
        few = Mixed.measured(measured)
        at = {"mix": share, "repeat": repeat}
        suffix = f"mix{share:g}-r{repeat}"
        for name in arms.baselines():
            self._arm(at | {"method": name}, f"{name}-{suffix}", few, name)
        self._arm(at | {"method": arms.LOWER.name}, f"{arms.LOWER.name}-{suffix}", few)
        asked_for = self.config.synthesizer
        for name in dict.fromkeys((*asked_for, *(name for name in COMPARED if can_draw(name, self.train)))):
            mixed = self._synthesize(at | {"synthesizer": name}, f"synthesis_{name}-{suffix}", measured, withheld)
            if name in asked_for:
                self._arm(at | {"method": arms.turbo(name)}, f"{arms.turbo(name)}-{suffix}", mixed)
        # the same whatever the share, so its step is shared by all of them
        self._arm(at | {"method": arms.UPPER.name}, f"{arms.UPPER.name}-r{repeat}", Mixed.measured(self.train))

    def _arm(self, arm: Row, step: str, train: Mixed, name: str = arms.NETWORK) -> None:
        """Trains one estimator and tests it."""

        def compute() -> Row:
            settings = Settings(self.train.grid, self.config.seed + arm["repeat"], self.device, self.config.preset)
            estimator, began = ESTIMATORS[name].make(settings), time.perf_counter()
            estimator.fit(train)
            fitted = time.perf_counter()
            estimate = estimator.estimate(self.test.spectrum)
            seconds = {"train": fitted - began, "estimate": time.perf_counter() - fitted}
            return {"estimate": estimate, "seconds": seconds, "history": estimator.history}

        done = self.directory.step(step, compute)
        estimate = torch.tensor(done["value"]["estimate"], dtype=torch.float64)
        errors = angle_errors(estimate, self.test.label)
        columns = {
            "index": self.test.index,
            "line_of_sight": self.test.line_of_sight,
            "truth_azimuth_deg": self.test.label[:, 0].rad2deg(),
            "truth_elevation_deg": self.test.label[:, 1].rad2deg(),
            "estimate_azimuth_deg": estimate[:, 0].rad2deg(),
            "estimate_elevation_deg": estimate[:, 1].rad2deg(),
            **{f"{kind}_deg": error.rad2deg() for kind, error in errors.items()},
        }
        self.errors += _rows(arm, columns)
        self.history += [arm | row for row in done["value"]["history"]]
        self.training_seconds.append(arm | done["value"]["seconds"])

    def _synthesize(self, arm: Row, step: str, measured: Spectra, withheld: Places) -> Mixed:
        """The mixed training set of one synthesizer, and its quality at the test positions."""
        file = self.directory.path(f"steps/{step}.safetensors")
        name = arm["synthesizer"]

        def compute() -> Row:
            fit = _FitHistory()
            settings = SynthesizerSettings(
                validation="random",  # the withheld places lie among the measured ones, whatever the split of the test
                seed=self.config.seed + arm["repeat"],
                preset=self.config.preset,
                device=self.device,
                checkpoint=self.directory.path(f"steps/{step}-fit.safetensors"),
                on_record=fit.add,
            )
            synthesizer = make_synthesizer(name, settings)
            synthesizer.fit(measured)
            fitted = time.perf_counter()
            synthetic = {
                "withheld": synthesizer.synthesize(withheld.position),
                "test": synthesizer.synthesize(self.test.position),
            }
            seconds = {"fit": fitted - fit.began + fit.earlier, "synthesize": time.perf_counter() - fitted}
            write(file, "synthetic spectra", synthetic, {})
            model = synthesizer.model
            if model is not None and name in self.config.synthesizer and arm["repeat"] == 0:
                prefix = "model" if name == "swiftwrf" else name
                model.save(self.directory.path(f"{prefix}-mix{arm['mix']:g}.safetensors"))
            return {"history": fit.records, "seconds": seconds}

        value = self.directory.step(step, compute)["value"]
        _, synthetic, _ = read(file, "synthetic spectra")
        scores = {key: score(synthetic["test"], self.test.spectrum) for key, score in SCORE.items()}
        self.synthesis += _rows(arm, {"index": self.test.index} | scores)
        self.history += [arm | row for row in value["history"]]
        self.synthesis_seconds.append(arm | value["seconds"])
        if arm["repeat"] == 0 and name == self.config.synthesizer[0]:
            self._keep_examples(arm["mix"], synthetic["test"], scores["psnr_db"])
        return mix(measured, withheld, synthetic["withheld"])

    def _keep_examples(self, share: float, synthetic: Tensor, score: Tensor) -> None:
        """Measured and synthetic spectra at test positions for the report, chosen by rule."""
        order = score.argsort()
        chosen = order[[round(q * (len(order) - 1)) for q in EXAMPLE_QUANTILES]]
        examples = {
            "measured": _as_bytes(self.test.spectrum[chosen]),
            "synthetic": _as_bytes(synthetic[chosen]),
            "index": self.test.index[chosen].numpy(),
            "psnr_db": score[chosen].numpy(),
        }
        self.directory.write_npz(f"examples-mix{share:g}.npz", examples)

    def summary(self, share: float) -> MixMetrics:
        """What metrics.json says of one share."""
        training, fits = (_of(share, rows) for rows in (self.training_seconds, self.synthesis_seconds))
        asked_for = fits[fits["synthesizer"].isin(self.config.synthesizer)]
        networks = training[~training["method"].isin(arms.baselines())]
        return {
            "n_measured": round(share * len(self.train)),
            "synthesis": _synthesis_metrics(_of(share, self.synthesis), fits),
            "methods": _arm_metrics(_of(share, self.errors), training),
            "seconds": {
                "fit": float(asked_for["fit"].sum()),
                "synthesize": float(asked_for["synthesize"].sum()),
                "train": float(networks["train"].sum()),
            },
        }


class _FitHistory:
    """The records of a fit, and the seconds that it took in sessions before this one."""

    def __init__(self) -> None:
        self.records: list[Row] = []
        self.began, self.earlier = time.perf_counter(), 0.0

    def add(self, record: Row) -> None:
        """One record; those of earlier sessions come first."""
        self.records.append(record)
        self.earlier = max(self.earlier, record.get("elapsed", 0.0) - (time.perf_counter() - self.began))


def _of(share: float, rows: list[Row]) -> DataFrame:
    return DataFrame([row for row in rows if row["mix"] == share])


def _synthesis_metrics(scores: DataFrame, seconds: DataFrame) -> dict[str, SynthesisMetrics]:
    spent = averaged(seconds, "synthesizer", ("fit", "synthesize"))
    return {
        name: {
            "psnr_db": of["psnr_db"],
            "ssim": of["ssim"],
            "l1": of["l1"],
            "seconds": {"fit": spent[name]["fit"], "synthesize": spent[name]["synthesize"]},
        }
        for name, of in repeats_averaged(scores, "synthesizer", SCORES).items()
    }


def _arm_metrics(errors: DataFrame, seconds: DataFrame) -> dict[str, ArmMetrics]:
    spent = averaged(seconds, "method", ("train", "estimate"))
    return {
        name: {
            "azimuth_deg": of["azimuth_deg"],
            "elevation_deg": of["elevation_deg"],
            "great_circle_deg": of["great_circle_deg"],
            "seconds": {"train": spent[name]["train"], "estimate": spent[name]["estimate"]},
        }
        for name, of in repeats_averaged(errors, "method", ANGLES).items()
    }


def _rows(arm: Row, columns: dict[str, Tensor]) -> list[Row]:
    lists = {name: column.tolist() for name, column in columns.items()}
    return [arm | dict(zip(lists, values, strict=True)) for values in zip(*lists.values(), strict=True)]


def _as_bytes(spectrum: Tensor) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return (spectrum.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
