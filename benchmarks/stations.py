"""Positions by the spectra of several stations, against each station alone, triangulation and nearest neighbours.

python benchmarks/stations.py --draws 3

Scenes are the simulated office with 100 measured transmissions and little or much phase noise. --rooms adds furnished rooms
with three arrays under the ceiling, one a draw, that Sionna RT traces, with spectra alone or, with --subcarriers, channels:

python benchmarks/stations.py --scenes --rooms 10 --subcarriers 8 --bandwidth 20e6 --snr-db 20 --n-measured 240 --n-test 60 \
    --name stations_rooms

The results of a scene have a row for each draw, and their medians. Test transmissions take no part in any fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from locating_aoa import furnished_room, impaired, median_of, quantiles
from record import RESULTS, options, write_result

from swiftwrf import Stations, simulated_stations
from swiftwrf.contrib.comparison.stations import ALONE, compare_stations
from swiftwrf.metrics import LEVEL

N_ARRAYS = 3
OFFICES: dict[str, dict[str, Any]] = {"office": {"phase_noise": 0.1}, "noisy": {"phase_noise": 0.4, "snr_db": 15.0}}
SPLIT = "measured"


@dataclass(frozen=True)
class Config:
    scenes: tuple[Literal["office", "noisy"], ...] = ("office", "noisy")
    """simulated offices: 0.1 rad of phase noise, or 0.4 rad and a signal-to-noise ratio of 15 dB"""
    draws: int = 3
    """draws of positions and noise"""
    n_measured: int = 100
    """number of measured transmissions"""
    n_test: int = 233
    """number of test transmissions: those that are left with 30 % measured"""
    rooms: int = 0
    """number of furnished rooms that are traced"""
    subcarriers: int | None = None
    """number of subcarriers at which channels of ray paths are used; spectra alone by default"""
    bandwidth: float | None = None
    """distance of the first and the last of them [Hz]"""
    snr_db: float | None = None
    """signal-to-noise ratio of each packet of a traced room, whose delay and phase are random [dB]"""
    name: str = "stations"
    """name of the result"""
    out: Path = RESULTS
    """folder of the result"""


def main(config: Config) -> None:
    """Measure every scene and draw, and write the result."""
    torch.set_num_threads(1)
    found: dict[str, Any] = {}
    for name, draws in scenes(config):
        rows = []
        for draw, data in enumerate(draws):
            rows.append(measure(data, draw))
            print(name, rows[-1], flush=True)
            found[name] = {"median": median_of(rows), "draws": rows}
            write_result(config.name, {"scenes": found}, folder=config.out)


def scenes(config: Config) -> Iterator[tuple[str, Iterator[Stations]]]:
    """Yield the name of each scene and its transmissions, one data set for each draw."""
    known, count = config.n_measured, config.n_measured + config.n_test
    for name in config.scenes:
        draws = (simulated_stations(count, N_ARRAYS, seed=draw, **OFFICES[name]) for draw in range(config.draws))
        yield name, (with_split(data, known) for data in draws)
    if config.rooms:
        alone = "" if config.subcarriers else ", spectra alone"
        yield (
            f"furnished rooms{alone}",
            (with_split(furnished_rooms(config, seed), known) for seed in range(config.rooms)),
        )


def furnished_rooms(config: Config, seed: int) -> Stations:
    """Return the spectra of three arrays in one traced room, those of `locating_aoa` in three corners."""
    parts = [furnished_room(seed, config.subcarriers, config.bandwidth, corner) for corner in range(N_ARRAYS)]
    if config.snr_db is not None:
        parts = [impaired(part, config.snr_db, N_ARRAYS * seed + n) for n, part in enumerate(parts)]
    data = Stations({f"corner {n}": part for n, part in enumerate(parts, start=1)}, name="furnished room")
    return data[: config.n_measured + config.n_test]


def with_split(data: Stations, n_measured: int) -> Stations:
    """Return the data with the split whose first transmissions are measured."""
    return data.derived(named_splits={SPLIT: (torch.arange(n_measured), torch.arange(n_measured, len(data)))})


def measure(data: Stations, draw: int) -> dict[str, Any]:
    """Return position errors by method, directions, coverage and seconds of one draw."""
    result = compare_stations(data, split=SPLIT, seed=draw)
    errors = result.errors
    position = {
        name: quantiles(torch.tensor(own["position_error_m"].to_numpy())) for name, own in errors.groupby("method")
    }
    alone = [position[ALONE + name] for name in data.names]
    seconds = {name: values["seconds"] for name, values in result.values.items()}
    one = [seconds[ALONE + name]["predict"] for name in data.names]
    return {
        "draw": draw,
        "n_measured": len(result.train),
        "n_test": len(result.test),
        "position_m": position,
        "best_station_m": min(alone, key=lambda own: own["median"]),
        f"coverage_{100 * LEVEL:.0f}": result.coverage[LEVEL],
        "direction_deg": result.directions.drop(columns="station").median().to_dict(),
        "line_of_sight": {n: float(data.of(n)[1].line_of_sight.double().mean()) for n in data.names},
        "weights": result.values["posterior"]["weights"],
        "seconds": seconds,
        "locate_ratio": seconds["posterior"]["predict"] / float(np.mean(one)),
    }


if __name__ == "__main__":
    main(options(Config))
