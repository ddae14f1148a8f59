"""Turbo learning measured: the same network trained on few measured spectra, on those and synthetic ones, and on all."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from augment.synthesize import Coarray, SwiftWRFSynthesizer
from torch import Tensor

from augment import SYNTHESIZERS, Mixed, Places, make_synthesizer, mix, withhold
from swiftwrf import FitConfig, InputError, Spectra, load_spectra, simulated_room
from swiftwrf.arrays import PlanarArray
from swiftwrf.checkpoint import read, write
from swiftwrf.metrics import angle_errors, l1, psnr, ssim, summary
from tasks.aoa.aann import AANN, AANNConfig
from tasks.aoa.estimators import Constant, Estimator, NearestSpectrum, Peak
from tasks.report import write_report
from tasks.run import Row, Run, choose_device, console

ANGLES = ("azimuth_deg", "elevation_deg", "great_circle_deg")
SCORES = {"psnr_db": psnr, "ssim": ssim, "l1": l1}
COMPARED = ("nearest", "idw", "gp")  # synthesizers that are always measured beside those asked for
EXAMPLE_QUANTILES = (1.0, 0.8, 0.6, 0.4, 0.2, 0.0)  # of the PSNR at the test positions: the best to the worst spectrum


@dataclass(frozen=True)
class AoaConfig:
    """Angle of arrival with few measured spectra: turbo learning against its bounds and baselines.

    Without --data the built-in simulated room is used. An interrupted run goes on with --resume DIR.
    """

    mix: tuple[float, ...]
    """measured shares, each in (0, 1]: 0.3 keeps 30 % of the training spectra and synthesizes the others"""
    data: str | None = None
    """folder of spectra (NeRF2 layout) or of ray paths (paths.npz)"""
    split: str = "random"
    """a split that comes with the data, or a seeded one: random or block"""
    synthesizer: tuple[str, ...] = ("swiftwrf",)
    """who draws the synthetic spectra: swiftwrf, nearest, idw, gp, coarray"""
    array: tuple[int, float, float] | None = None
    """square array that took the spectra, where the data do not say: elements a side, spacing [m], carrier [Hz]"""
    preset: Literal["quick", "paper"] = "quick"
    """quick: sized for a CPU; paper: the paper's model and a long training, for a GPU"""
    repeats: int = 1
    """runs with different random shares and networks, pooled"""
    seed: int = 0
    """of everything random"""
    out: str | None = None
    """directory of the run; must not exist (default: a new one under runs/aoa)"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """where to compute"""


def run(config: AoaConfig, resume: Path | None = None) -> None:
    """Runs the experiment and writes its directory, or goes on with an interrupted one.

    Raises:
        InputError: what the configuration asks for is not there or makes no sense.
    """
    device = choose_device(config.device)
    _check(config)
    data = load_spectra(config.data) if config.data else simulated_room(seed=config.seed)
    if config.array is not None:
        side, spacing, frequency = config.array
        data = replace(data, array=PlanarArray.square(side, frequency, spacing))
    if "coarray" in config.synthesizer and data.array is None:
        raise InputError(f"synthesizer coarray needs the array, which {data.name} does not tell; give it with --array")
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
        metrics = {
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
        final = directory.finish(metrics, write_report)
    console.print(f"report: [bold]{final / 'report.html'}[/]")


def _check(config: AoaConfig) -> None:
    unknown = [name for name in config.synthesizer if name not in SYNTHESIZERS]
    if unknown:
        raise InputError(f"unknown synthesizer {unknown[0]!r}; choose from {', '.join(SYNTHESIZERS)}")
    if not config.mix or not all(0 < share <= 1 for share in config.mix):
        raise InputError(
            f"--mix takes measured shares in (0, 1], got {' '.join(f'{s:g}' for s in config.mix) or 'none'}"
        )
    if len(set(config.mix)) < len(config.mix):
        raise InputError(f"--mix names a share twice: {' '.join(f'{s:g}' for s in config.mix)}")
    if config.array is not None and not (config.array[0] >= 2 and min(config.array[1:]) > 0):
        raise InputError(
            f"--array takes at least 2 elements a side, a spacing [m] and a carrier [Hz], got {config.array}"
        )
    if config.repeats < 1:
        raise InputError(f"--repeats must be at least 1, got {config.repeats}")


class _Experiment:
    """Trains and tests every arm, each a step of the run's directory, and gathers the tables of the run."""

    def __init__(self, config: AoaConfig, train: Spectra, test: Spectra, device: torch.device, directory: Run) -> None:
        self.config, self.train, self.test, self.device, self.directory = config, train, test, device, directory
        self.fit_config = FitConfig.paper() if config.preset == "paper" else FitConfig()
        self.aann_config = AANNConfig.paper() if config.preset == "paper" else AANNConfig()
        self.errors: list[Row] = []
        self.synthesis: list[Row] = []
        self.history: list[Row] = []
        self.seconds: list[Row] = []

    def turbo(self, share: float, repeat: int) -> None:
        """All arms at one measured share."""
        measured, withheld = withhold(self.train, share, self.config.seed + repeat)
        few = Mixed.measured(measured)
        at = {"mix": share, "repeat": repeat}
        suffix = f"mix{share:g}-r{repeat}"
        network = partial(AANN, self.aann_config, self.config.seed + repeat, self.device)
        without: dict[str, Callable[[], Estimator]] = {
            "peak": partial(Peak, self.train.grid),
            "constant": Constant,
            "nearest_spectrum": NearestSpectrum,
            "measured_only": network,
        }
        for name, make in without.items():
            self._arm(at | {"method": name}, f"{name}-{suffix}", few, make)
        compared = COMPARED if self.train.array is None else (*COMPARED, "coarray")
        for name in dict.fromkeys((*self.config.synthesizer, *compared)):
            mixed = self._synthesize(at | {"synthesizer": name}, f"synthesis_{name}-{suffix}", measured, withheld)
            if name in self.config.synthesizer:
                self._arm(at | {"method": f"turbo_{name}"}, f"turbo_{name}-{suffix}", mixed, network)
        # the same whatever the share, so its step is shared by all of them
        self._arm(at | {"method": "measured_all"}, f"measured_all-r{repeat}", Mixed.measured(self.train), network)

    def _arm(self, arm: Row, step: str, train: Mixed, make: Callable[[], Estimator]) -> None:
        """Trains one estimator and tests it."""

        def compute() -> Row:
            estimator, began = make(), time.perf_counter()
            estimator.fit(train)
            fitted = time.perf_counter()
            estimate = estimator.estimate(self.test.spectrum)
            seconds = {"train": fitted - began, "estimate": time.perf_counter() - fitted}
            return {"estimate": estimate, "seconds": seconds, "history": getattr(estimator, "history", [])}

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
        self.seconds.append(arm | done["value"]["seconds"])

    def _synthesize(self, arm: Row, step: str, measured: Spectra, withheld: Places) -> Mixed:
        """The mixed training set of one synthesizer, and its quality at the test positions."""
        file = self.directory.path(f"steps/{step}.safetensors")
        name = arm["synthesizer"]

        def compute() -> Row:
            history: list[Row] = []
            synthesizer = make_synthesizer(
                name,
                validation="random",  # the withheld places lie among the measured ones, whatever the split of the test
                seed=self.config.seed + arm["repeat"],
                config=self.fit_config,
                device=self.device,
                checkpoint=self.directory.path(f"steps/{step}-fit.safetensors"),
                on_record=history.append,
            )
            began = time.perf_counter()
            synthesizer.fit(measured)
            fitted = time.perf_counter()
            synthetic = {
                "withheld": synthesizer.synthesize(withheld.position),
                "test": synthesizer.synthesize(self.test.position),
            }
            seconds = {"fit": fitted - began, "synthesize": time.perf_counter() - fitted}
            write(file, "synthetic spectra", synthetic, {})
            asked_for = name in self.config.synthesizer and arm["repeat"] == 0
            if asked_for and isinstance(synthesizer, SwiftWRFSynthesizer | Coarray):
                prefix = "model" if name == "swiftwrf" else name
                synthesizer.save(self.directory.path(f"{prefix}-mix{arm['mix']:g}.safetensors"))
            return {"history": history, "seconds": seconds}

        value = self.directory.step(step, compute)["value"]
        synthetic, _ = read(file, "synthetic spectra")
        scores = {key: score(synthetic["test"], self.test.spectrum) for key, score in SCORES.items()}
        self.synthesis += _rows(arm, {"index": self.test.index} | scores)
        self.history += [arm | row for row in value["history"]]
        self.seconds.append(arm | value["seconds"])
        if arm["repeat"] == 0 and name == self.config.synthesizer[0]:
            self._keep_examples(arm["mix"], synthetic["test"], scores["psnr_db"])
        return mix(measured, withheld, synthetic["withheld"])

    def _keep_examples(self, share: float, synthetic: Tensor, score: Tensor) -> None:
        """Measured and synthetic spectra at test positions for the report, chosen by rule."""
        order = score.argsort()
        chosen = order[[round(q * (len(order) - 1)) for q in EXAMPLE_QUANTILES]]
        np.savez_compressed(
            self.directory.path(f"examples-mix{share:g}.npz"),
            measured=_as_bytes(self.test.spectrum[chosen]),
            synthetic=_as_bytes(synthetic[chosen]),
            index=self.test.index[chosen].numpy(),
            psnr_db=score[chosen].numpy(),
        )

    def summary(self, share: float) -> Row:
        """What metrics.json says of one share."""
        errors = [row for row in self.errors if row["mix"] == share]
        synthesis = [row for row in self.synthesis if row["mix"] == share]
        seconds = [row for row in self.seconds if row["mix"] == share]
        own = [row for row in seconds if row.get("synthesizer") in self.config.synthesizer]
        networks = [row for row in seconds if row.get("method", "").startswith(("measured", "turbo"))]
        return {
            "n_measured": round(share * len(self.train)),
            "synthesis": _summaries(synthesis, "synthesizer", tuple(SCORES), seconds),
            "methods": _summaries(errors, "method", ANGLES, seconds),
            "seconds": {
                "fit": sum(row["fit"] for row in own),
                "synthesize": sum(row["synthesize"] for row in own),
                "train": sum(row["train"] for row in networks),
            },
        }


def _rows(arm: Row, columns: dict[str, Tensor]) -> list[Row]:
    lists = {name: column.tolist() for name, column in columns.items()}
    return [arm | dict(zip(lists, values, strict=True)) for values in zip(*lists.values(), strict=True)]


def _summaries(rows: list[Row], key: str, columns: tuple[str, ...], seconds: list[Row]) -> dict[str, Any]:
    """Summary of each column under each value of `key`, and the seconds that its stages took, a repeat. Repeats of a test
    spectrum are averaged first: they are not independent, and the interval must not shrink with their number."""
    result: dict[str, Any] = {}
    for name in dict.fromkeys(row[key] for row in rows):
        own = [row for row in rows if row[key] == name]
        indices = dict.fromkeys(row["index"] for row in own)
        result[name] = {
            column: summary([np.mean([row[column] for row in own if row["index"] == index]) for index in indices])
            for column in columns
        }
        spent = [row for row in seconds if row.get(key) == name]
        stages = [stage for stage in ("fit", "synthesize", "train", "estimate") if stage in spent[0]]
        result[name]["seconds"] = {stage: float(np.mean([row[stage] for row in spent])) for stage in stages}
    return result


def _as_bytes(spectrum: Tensor) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return (spectrum.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
