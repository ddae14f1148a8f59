"""Directions and positions by matched-field processing on few measured spectra or channels, and predicted channels.

python benchmarks/locating_aoa.py --data /data/newrf-bedroom /data/newrf-office --fractions 0.1 0.3 --draws 3 --kernel

With --subcarriers, channels are computed from ray paths, and predicted at the test positions, too. The split is the random
one of seed 0.
Draws differ in the spectra that count as measured. Test spectra take no part in any fit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from record import RESULTS, options, write_result

from augment import Mixed, withhold
from augment.estimators import make_estimator
from augment.turbo.artifacts import LEVEL
from augment.turbo.experiment import ROOM_MODEL
from augment.turbo.stages import located
from swiftwrf import (
    FitError,
    GeometryModel,
    InputError,
    MatchedField,
    Spectra,
    load_spectra,
    make_model,
    simulated_room,
)
from swiftwrf.choices import fraction_key
from swiftwrf.data.splits import folds
from swiftwrf.gp import GaussianProcess, choose_kernel
from swiftwrf.metrics import angle_errors, summary
from swiftwrf.models.geometry.channels import coherence, field, waves

KERNEL = "kernel_regression"
Row = dict[str, Any]


@dataclass(frozen=True)
class Config:
    scenes: tuple[Literal["room", "room-receiver"], ...] = ("room", "room-receiver")
    """built-in rooms, the transmitter or the receiver moves"""
    data: tuple[Path, ...] = ()
    """folders of spectra"""
    fractions: tuple[float, ...] = (0.3,)
    """measured fractions of the training spectra"""
    draws: int = 3
    """draws of the measured spectra"""
    subcarriers: int | None = None
    """number of subcarriers at which channels of ray paths are used; spectra alone by default"""
    bandwidth: float | None = None
    """distance of the first and the last of them [Hz]"""
    kernel: bool = False
    """measure kernel regression on the same spectra, too"""
    name: str = "locating_spectra"
    """name of the result"""
    out: Path = RESULTS
    """folder of the result"""


def main(config: Config) -> None:
    """Measure every scene, measured fraction and draw, and write the result."""
    torch.set_num_threads(1)
    found: dict[str, Any] = {}
    for name, data in scenes(config):
        train, test = data.split("random")
        found[name] = {}
        for fraction in config.fractions:
            rows = []
            for draw in range(config.draws):
                rows.append(measure(withhold(train, fraction, draw)[0], test, draw, config.kernel))
                print(name, fraction, rows[-1], flush=True)
            found[name][fraction_key(fraction)] = {"median": median_of(rows), "draws": rows}
            write_result(config.name, {"scenes": found}, folder=config.out)


def scenes(config: Config) -> Iterator[tuple[str, Spectra]]:
    """Yield name and spectra of each scene."""
    for name in config.scenes:
        yield name, simulated_room(moving="transmitter" if name == "room" else "receiver")
    for folder in config.data:
        yield folder.name, load_spectra(folder, subcarriers=config.subcarriers, bandwidth=config.bandwidth)


def measure(measured: Spectra, test: Spectra, draw: int, kernel: bool) -> Row:
    """Return errors, coverage and seconds of one draw, or the reason why the spectra cannot be located."""
    row: Row = {"draw": draw, "n_measured": len(measured), "n_test": len(test)}
    if kernel:
        estimate = make_estimator(KERNEL, seed=draw).fit(Mixed.measured(measured)).predict(test.spectrum)
        row[f"{KERNEL}_angle_deg"] = angle_summary(estimate, test)
    began = time.perf_counter()
    try:
        room = make_model(ROOM_MODEL, seed=draw).fit(measured)
        searched = time.perf_counter()
        if measured.channel is not None:
            row["channel"] = channel_scores(room.room, measured, test, draw)
        if room.room is None or not room.room.planes:
            return row | {"left_out": "no plane explains the spectra"}
        locator = MatchedField(seed=draw).fit(measured, room=room)
    except (InputError, FitError) as error:
        return row | {"left_out": str(error)}
    fitted = time.perf_counter()
    result = located(locator, test)
    seconds = {"room": searched - began, "fit": fitted - searched, "locate": time.perf_counter() - fitted}
    return row | {
        "planes": len(locator.room.planes),
        "weights": locator.weight.tolist(),
        "angle_deg": angle_summary(result["estimate"], test),
        "position_m": quantiles((result["position"] - test.position).norm(dim=1)),
        f"coverage_{100 * LEVEL:.0f}": float((result["level"] < LEVEL).double().mean()),
        "ambiguous": float(result["ambiguous"].double().mean()),
        "seconds": seconds,
    }


def channel_scores(room: GeometryModel, measured: Spectra, test: Spectra, seed: int) -> Row:
    """Return coherence and normalised mean squared error [dB] of channels predicted at the test positions, by method.

    The factor that planes and furniture leave open is fitted to the measured channels.
    """
    known, truth = room.channels(measured), room.channels(test)
    value, fold = torch.view_as_real(known.value).flatten(1), folds(measured.position, "random", seed)
    process = GaussianProcess.regress(
        choose_kernel(measured.position, value[:, None], fold),
        measured.position,
        value,
        exact=True,
        dtype=torch.float32,
    )
    mean = process.mean(test.position).reshape(*truth.value.shape, 2)
    closest = torch.cdist(test.position, measured.position).argmin(dim=1)
    predicted = {
        "mean": known.value.mean(dim=0).expand_as(truth.value),
        "nearest": known.value[closest],
        "gaussian_process": torch.view_as_complex(mean.contiguous()),
    }
    walls = copy(room)
    walls.furniture = None
    for name, model in {"planes": walls, "furniture": room}.items():
        at_known, at_test = (
            field(model.gains(part.scene), waves(model.reflectors, part.scene, part.frequency))
            for part in (known, truth)
        )
        factor = (at_known.conj() * known.value).sum() / at_known.abs().square().sum()
        predicted[name] = factor * at_test
    power = truth.value.abs().square().sum()
    return {
        name: {
            "coherence": float(coherence(truth.value, channel).mean()),
            "nmse_db": 10 * math.log10(float((truth.value - channel).abs().square().sum() / power)),
        }
        for name, channel in predicted.items()
    }


def angle_summary(estimate: torch.Tensor, test: Spectra) -> dict[str, float]:
    """Return median and 90th percentile of the angular errors [deg]."""
    return quantiles(angle_errors(estimate, test.label)["great_circle"].rad2deg())


def quantiles(values: torch.Tensor) -> dict[str, float]:
    """Return median and 90th percentile."""
    found = summary(values)
    return {"median": found["median"], "p90": found["p90"]}


def median_of(rows: list[Row]) -> Row:
    """Return the median over the draws of every number that all draws have."""
    found: Row = {}
    for name, value in rows[0].items():
        values = [row.get(name) for row in rows]
        if any(other is None for other in values) or name == "draw":
            continue
        if isinstance(value, dict):
            found[name] = median_of(values)  # type: ignore[arg-type]
        elif isinstance(value, int | float):
            found[name] = float(np.median(np.array(values, dtype=float)))
    return found


if __name__ == "__main__":
    main(options(Config))
