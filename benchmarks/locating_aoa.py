"""Directions and positions by matched-field processing on few measured spectra or channels, and predicted channels.

python benchmarks/locating_aoa.py --data /data/newrf-bedroom /data/newrf-office --fractions 0.1 0.3 --draws 3 --kernel

With --subcarriers, channels are computed from ray paths, and predicted at the test positions, too. --snr-db adds noise to
them, a delay and a phase of each packet. --rooms adds furnished rooms, one a draw, that Sionna RT traces:

python benchmarks/locating_aoa.py --scenes --rooms 10 --subcarriers 8 --bandwidth 20e6 --snr-db 20 --n-test 60 --kernel

Measured channels, of RFID tags on other days:

python benchmarks/locating_aoa.py --scenes --data /data/adarf-d1 --split published --round-trip --fractions 0.5 --kernel

The split is the random one of seed 0 unless another is given. Draws differ in the spectra that count as measured. Test
spectra take no part in any fit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from record import RESULTS, options, write_result

from augment import Mixed, withhold
from augment.choices import fraction_key
from augment.estimators import ESTIMATORS, make_estimator
from augment.turbo.experiment import ROOM_MODEL
from augment.turbo.stages import located
from swiftwrf import (
    AngularGrid,
    FitError,
    GeometryModel,
    InputError,
    MatchedField,
    Spectra,
    load_spectra,
    make_model,
    simulated_room,
)
from swiftwrf.choices import Moving
from swiftwrf.contrib.comparison.errors import summary
from swiftwrf.contrib.raytraced import FurnishedRoom, Material, Scene, Tracing, trace
from swiftwrf.data.spectra import array_spectra
from swiftwrf.data.splits import folds
from swiftwrf.gp import GaussianProcess, choose_kernel
from swiftwrf.metrics import LEVEL, angle_errors
from swiftwrf.models.geometry.channels import coherence, superposed, waves

KERNEL = "kernel_regression"
MAX_DELAY_S = 100e-9  # of a packet
WALL = Material("wall", 1.0, 9.0, 0.3)  # reflects -0.5 of the amplitude at normal incidence
N_BOXES, N_POSITIONS = 6, 1000
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
    rooms: int = 0
    """number of furnished rooms that are traced"""
    split: Literal["random", "published"] = "random"
    """split of training and test spectra"""
    round_trip: bool = False
    """phases are those of the way there and back"""
    snr_db: float | None = None
    """signal-to-noise ratio of each packet, whose delay and phase are random [dB]; no impairment by default"""
    n_test: int | None = None
    """number of test spectra at most"""
    kernel: bool = False
    """measure kernel regression on the same spectra, and MUSIC and maximum likelihood on the channels, too"""
    name: str = "locating_spectra"
    """name of the result"""
    out: Path = RESULTS
    """folder of the result"""


def main(config: Config) -> None:
    """Measure every scene, measured fraction and draw, and write the result."""
    torch.set_num_threads(1)
    found: dict[str, Any] = {}
    for name, draws in scenes(config):
        rows: dict[str, list[Row]] = {fraction_key(fraction): [] for fraction in config.fractions}
        for draw, data in enumerate(draws):
            train, test = (data if config.snr_db is None else impaired(data, config.snr_db, draw)).split(config.split)
            test = test.subset(torch.arange(min(len(test), config.n_test or len(test))))
            coherent = config.subcarriers is not None and config.snr_db is None
            for fraction in config.fractions:
                own = rows[fraction_key(fraction)]
                measured = withhold(train, fraction, draw)[0]
                own.append(measure(measured, test, draw, config.kernel, coherent))
                print(name, fraction, own[-1], flush=True)
            found[name] = {key: {"median": median_of(own), "draws": own} for key, own in rows.items()}
            write_result(config.name, {"scenes": found}, folder=config.out)


def scenes(config: Config) -> Iterator[tuple[str, Iterable[Spectra]]]:
    """Yield the name of each scene and its spectra, one for each draw."""
    for name in config.scenes:
        yield name, repeat(simulated_room(moving="transmitter" if name == "room" else "receiver"), config.draws)
    where = "" if config.snr_db is None else f", {(config.bandwidth or 0) / 1e6:g} MHz, {config.snr_db:g} dB"
    for folder in config.data:
        options = {"subcarriers": config.subcarriers, "bandwidth": config.bandwidth, "round_trip": config.round_trip}
        yield folder.name + where, repeat(load_spectra(folder, **options), config.draws)
    if config.rooms:
        yield (
            "furnished rooms" + where,
            map(
                partial(furnished_room, subcarriers=config.subcarriers, bandwidth=config.bandwidth), range(config.rooms)
            ),
        )


def furnished_room(
    seed: int, subcarriers: int | None = None, bandwidth: float | None = None, corner: int | None = None
) -> Spectra:
    """Return spectra and channels in a room of random size with boxes of wood, metal and chipboard on its floor.

    The fixed end is under the ceiling in the first corner, and either end moves. If a corner is given, 0 to 3, the array
    is in that corner of the same room, and the transmitter moves.
    """
    generator = np.random.default_rng(seed)
    size = generator.uniform((5, 4, 2.6), (7, 6, 3.2))
    fixed = np.append(generator.uniform(0.2, 0.6, 2), size[2] - 0.3)  # under the ceiling in a corner
    boxes = []
    while len(boxes) < N_BOXES:
        extent = generator.uniform((0.4, 0.4, 0.5), (1.6, 1.6, 1.9))
        low = np.append(generator.uniform(0, size[:2] - extent[:2]), 0.0)
        if (low[:2] > fixed[:2] + 0.3).any():
            material = ("wood", "metal", "chipboard")[len(boxes) % 3]
            boxes.append((material, tuple(low), tuple(low + extent)))
    room = FurnishedRoom(tuple(size), "wall", "wall", "wall", tuple(boxes), tuple(fixed), ((0, 0, 0), (0, 0, 0)))
    surfaces = [s if s.material.name != WALL.name else replace(s, material=WALL) for s in room.surfaces()]
    position = torch.from_numpy(generator.uniform((0.4, 0.4, 0.8), (*size[:2] - 0.4, 1.7), (4 * N_POSITIONS, 3)))
    position = position[room.free(position)][:N_POSITIONS]
    moving: Moving = get_args(Moving)[seed % 2]
    if corner is not None:
        moving, mirrored = "transmitter", np.array([corner % 2, corner // 2, 0], dtype=bool)
        fixed = np.where(mirrored, size - fixed, fixed)
    ends = torch.from_numpy(fixed), position, moving
    paths = trace(Scene(surfaces, 2.4e9), *ends, Tracing(order=2, seed=seed), progress=False)
    reached = (paths.count > 0).nonzero()[:, 0]
    grid = AngularGrid.hemisphere(30, 120)
    return paths.reached.spectra(
        "furnished room", grid=grid, subcarriers=subcarriers, bandwidth_hz=bandwidth, index=reached
    )


def impaired(data: Spectra, snr_db: float, seed: int) -> Spectra:
    """Return packets with white noise, and with a delay and a phase of each packet."""
    if data.channel is None or data.frequency_hz is None or data.array is None:
        raise SystemExit("noise is added to channels; give --subcarriers")
    generator = torch.Generator().manual_seed(seed)
    delay, phase = torch.rand(2, len(data), 1, 1, generator=generator, dtype=torch.float64)
    away = (data.frequency_hz - data.frequency_hz.mean())[:, None]
    channel = data.channel * torch.polar(torch.ones_like(delay), math.tau * (phase - MAX_DELAY_S * delay * away))
    power = channel.abs().square().mean(dim=(1, 2), keepdim=True) * 10 ** (-snr_db / 10)
    channel = channel + power.sqrt() * torch.randn(channel.shape, generator=generator, dtype=channel.dtype)
    return replace(data, channel=channel, store=array_spectra(data.array, channel, data.grid))


def measure(measured: Spectra, test: Spectra, draw: int, kernel: bool, coherent: bool = True) -> Row:
    """Return errors, coverage and seconds of one draw, or the reason why the spectra cannot be located.

    With `coherent` the channels of all packets have one delay and one phase, so that errors of predicted channels count.
    """
    row: Row = {"draw": draw, "n_measured": len(measured), "n_test": len(test)}
    beside = [KERNEL, *(name for name, kind in ESTIMATORS.items() if not kind.trainable)] if kernel else []
    for name in beside:
        if not ESTIMATORS[name].lacking(test):
            estimator = make_estimator(name, seed=draw).fit(Mixed.measured(measured))
            row[f"{name}_angle_deg"] = angle_summary(estimator.estimate(test), test)
    began = time.perf_counter()
    try:
        room = make_model(ROOM_MODEL, seed=draw).fit(measured)
        searched = time.perf_counter()
        if measured.channel is not None:
            scores = channel_scores(room.room, measured, test, draw)
            row["channel"] = scores if coherent else {name: {"coherence": s["coherence"]} for name, s in scores.items()}
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
    kernel = choose_kernel(measured.position, value[:, None], fold)
    process = GaussianProcess(kernel, measured.position, value.float(), exact=True)
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
            superposed(model.gains(part.scene), waves(model.reflectors, part.scene, part.frequency))
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
