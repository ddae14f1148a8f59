"""Compare the heads of the angular network over steps and training sets, beside estimators without a network.

python benchmarks/networks.py --scenes room newrf-bedroom s23-200 --data /data

Errors are those of a part of the training split that is held out from every fit. Test spectra take no part. Seconds are
processor time of one thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

import torch
from record import kept, options, write_result
from torch import Tensor

from augment import Mixed, SyntheticPositions, mix, synthetic_positions, withhold
from augment.cross_validation import LOCATOR
from augment.estimators import make_estimator
from augment.estimators.aann import AANN
from augment.estimators.aann_kernel import AANNKernel, AANNKernelConfig
from augment.turbo.experiment import ROOM_MODEL
from swiftwrf import MatchedField, Spectra, load_spectra, make_model, simulated_room
from swiftwrf.metrics import angle_errors, paired_change, summary
from swiftwrf.models import FIELD_MODELS
from swiftwrf.runtime.validation import Preset

REFERENCE = "kernel_regression"  # estimator to which others are compared
N_EXTRA = 3000  # extra synthetic positions in rooms
Training = Literal["measured", "turbo", "all"]
Row = dict[str, Any]
Estimates = Iterator[tuple[str, Row, Tensor]]


@dataclass(frozen=True)
class Config:
    scenes: tuple[str, ...] = ("room",)
    """`room` for the built-in room, or names of folders in --data"""
    data: Path = Path()
    """folder of the folders of spectra"""
    trainings: tuple[Training, ...] = ("measured", "turbo", "all")
    """training sets: the measured fraction, that and synthetic spectra, all spectra measured"""
    fraction: float = 0.3
    """measured fraction of the spectra to fit"""
    steps: tuple[int, ...] = (30, 60, 125, 250, 500)
    """optimisation steps of the networks"""
    batch: int = 64
    """spectra a step; the paper's preset has its own"""
    presets: tuple[Preset, ...] = ("quick",)
    """options of the networks other than the number of steps"""
    seed: int = 0
    """seed of the measured fraction and of the networks"""
    name: str = "networks"
    """name of the result; the rows of an earlier one are kept"""


class TimedNetwork(AANNKernel):
    """The network with kernel regression, and the processor seconds that the network alone took to train."""

    def _fit_network(self, train: Mixed, device: torch.device) -> tuple[Tensor, Tensor]:
        began = time.process_time()
        fitted = super()._fit_network(train, device)
        self.network_seconds = time.process_time() - began
        return fitted


def main(config: Config) -> None:
    """Measure every method on every training set and write the result after each of them."""
    torch.set_num_threads(1)
    scenes: dict[str, Any] = dict(kept(config.name, "scenes"))
    for scene in config.scenes:
        data = simulated_room() if scene == "room" else load_spectra(config.data / scene)
        train, _ = data.split("random")
        fitted, held_out = train.split("random", seed=1)
        measured, withheld = withhold(fitted, config.fraction, config.seed)
        for training in config.trainings:
            known = fitted if training == "all" else measured
            entry: Row = {"n_measured": len(known), "n_held_out": len(held_out)}
            mixed = Mixed.measured(known)
            if training == "turbo":
                entry["synthesizer"] = synthesizer = ROOM_MODEL if has_room(known) else "swiftwrf"
                mixed = synthesized(measured, withheld, synthesizer, config.seed)
            entry["n_train"] = len(mixed)
            entry = scenes.setdefault(scene, {}).setdefault(f"{training}, seed {config.seed}", entry)
            methods = entry.setdefault("methods", {})
            for name, row, estimate in estimates(mixed, known, training, held_out, config):
                error = angle_errors(estimate, held_out.label)["great_circle"].rad2deg().double().numpy()
                row |= {"great_circle_deg": summary(error), "errors_deg": error.round(4).tolist()}
                row["change"] = paired_change(methods.get(REFERENCE, row)["errors_deg"], row["errors_deg"])
                methods[name] = row
                print(scene, training, name, f"{row['change']['median_deg']:.2f} deg", row["seconds"], flush=True)
                write_result(config.name, {"scenes": scenes}, rows=[row])


def has_room(data: Spectra) -> bool:
    """Return True if a room can be searched in the spectra."""
    return not FIELD_MODELS[ROOM_MODEL].lacking(data)


def synthesized(measured: Spectra, withheld: SyntheticPositions, name: str, seed: int) -> Mixed:
    """Return measured and synthetic spectra, those at extra positions where there is a room."""
    model = make_model(name, seed=seed).fit(measured)
    mixed = mix(measured, withheld, model.synthesize(withheld.position))
    if not has_room(measured):
        return mixed
    extra = synthetic_positions(measured, N_EXTRA, seed)
    return mixed.add(extra, model.synthesize(extra.position))


def estimates(mixed: Mixed, measured: Spectra, training: Training, held_out: Spectra, config: Config) -> Estimates:
    """Yield name, description and estimates (n, 2) [rad] of each method."""

    def finished(began: float, predict: Callable[[Tensor], Tensor], **row: Any) -> tuple[Row, Tensor]:
        fitted = time.process_time()
        estimate = predict(held_out.spectrum)
        seconds = {"train": fitted - began, "estimate": (time.process_time() - fitted) / len(held_out)}
        return row | {"seconds": seconds}, estimate

    for name in (REFERENCE, "nearest_spectrum"):
        began = time.process_time()
        estimator = make_estimator(name, seed=config.seed).fit(mixed)
        yield name, *finished(began, estimator.predict, estimator=name)
    if training != "turbo" and has_room(measured):
        began = time.process_time()
        room = make_model(ROOM_MODEL, seed=config.seed, validation="random").fit(measured)
        if room.room is not None and room.room.planes:
            locator = MatchedField(seed=config.seed).fit(measured, room=room)
            yield LOCATOR, *finished(began, locator.predict, estimator=LOCATOR)
    for preset, steps in product(config.presets, config.steps):
        options = AANNKernelConfig.paper() if preset == "paper" else AANNKernelConfig(batch=config.batch)
        began = time.process_time()
        network = TimedNetwork(replace(options, steps=steps, seed=config.seed)).fit(mixed)
        more = {"preset": preset, "steps": steps, "batch": options.batch}
        row, estimate = finished(began, network.predict, estimator="aann_kernel", **more)
        yield f"aann_kernel, {preset}, {steps} steps", row, estimate
        row, estimate = finished(began, partial(AANN.predict, network), estimator="aann", **more)
        row["seconds"]["train"] = network.network_seconds
        yield f"aann, {preset}, {steps} steps", row, estimate


if __name__ == "__main__":
    main(options(Config))
