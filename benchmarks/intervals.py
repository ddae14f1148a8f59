"""Measure which fraction of measured values lies in the 80 % intervals and regions that the models promise.

python benchmarks/intervals.py --data DATA

floor, rssi: intervals of `RssiModel` and regions of `RssiLocator`, on simulated floors and on public data sets.
room, spectra: intervals of field models, in the simulated room and on public data sets.
matched: regions of `MatchedField` in the simulated room.

Test rows of simulated data are at new positions in the region (random), or in a region of their own (block). The rules of
intervals were chosen on seeds from 100. Rows that were measured before and not again stay in the result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import torch
from record import kept, options, write_result

import swiftwrf
from swiftwrf import Rssi, Spectra
from swiftwrf.contrib.comparison.localizers import LEVELS
from swiftwrf.contrib.comparison.locating import LocateComparison
from swiftwrf.metrics import LEVEL, covered

RESULT = "intervals"
Study = Literal["floor", "room", "matched", "rssi", "spectra"]
SEEDED = ("random", "block")
N_TRAIN, N_SPECTRA, N_TEST = 200, 80, 400  # training positions; those of regions by spectra; random test rows
N_CELLS = 2000  # candidate positions of regions by RSSI
FIELDS = ("swiftwrf", "gp", "coarray")
N_BLOCKS = 5  # of a block split, one for each seed
RSSI = {"tetam-tracks": (*SEEDED, "spatial"), "tetam-fingerprints": ("random", "spatial")}
RSSI |= {"kolak": (*SEEDED, "spatial"), "lora-campus": ("random", "foot"), "gsm-recife": SEEDED}
RSSI |= {f"wifi-rooms/{name}": SEEDED for name in ("office", "lecture-theatre", "corridor")}
RSSI |= dict.fromkeys(("dae-2025", "ts-dsi1", "ts-tut2", "ts-tut5", "ts-ujib1"), ("published",))
SPECTRA = dict.fromkeys(("s23-200", "newrf-bedroom", "newrf-conference", "newrf-office"), SEEDED)
SPECTRA |= {f"wsr-{sight}-a-tx{number}": ("place",) for sight in ("los", "nlos") for number in (2, 3, 4)}
Data = Rssi | Spectra
Part = tuple[str, str, int, Data, Data]  # data set, split, seed, training and test rows
Row = tuple[str, int, float]  # what is measured, seed, covered fraction


@dataclass(frozen=True)
class Config:
    data: Path
    """folder of the public data sets"""
    studies: tuple[Study, ...] = ("floor", "room", "matched", "rssi", "spectra")
    first: int = 0
    """first seed of simulated measurements"""
    seeds: int = 40
    """number of seeds"""
    rows: int = 1000
    """training rows of a public data set at most, random ones"""


def main(config: Config) -> None:
    """Measure the studies and write `results/intervals.json`."""
    found = dict(kept(RESULT, "rows"))
    for study in config.studies:
        for name, seed, fraction in STUDIES[study](config):
            row = found.setdefault(f"{study}: {name}", {"coverage": {}})
            values = row["coverage"] | {str(seed): round(fraction, 3)}
            row |= {"coverage": values, "mean": sum(values.values()) / len(values), "least": min(values.values())}
            print(f"{study}: {name}, seed {seed}: {fraction:.2f}; mean {row['mean']:.3f}", flush=True)
            write_result(RESULT, {"level": LEVEL, "rows": found}, rows=[row])


def simulated(
    config: Config, make: Callable[..., Data], n: int = N_TRAIN, splits: Sequence[str] = SEEDED
) -> Iterator[Part]:
    """Yield parts of simulated measurements at n training positions."""
    for seed in range(config.first, config.first + config.seeds):
        data = make(n=n + N_TEST, seed=seed)
        first, others = (data.subset(rows) for rows in torch.arange(n + N_TEST).split([n, N_TEST]))
        for split in splits:
            yield data.name, split, seed, *((first, others) if split == "random" else first.split(split, seed))


def public(config: Config, read: Callable[[Path], Data], sets: dict[str, Sequence[str]]) -> Iterator[Part]:
    """Yield parts of public data sets, of all seeds of splits that do not come with them."""
    for name, splits in sets.items():
        data = read(config.data / name)
        for split in splits:
            for seed in range(1 if split in data.named_splits else N_BLOCKS):
                train, test = data.split(split, seed)
                some = torch.randperm(len(train), generator=torch.Generator().manual_seed(seed))[: config.rows]
                yield name, split, seed, train.subset(some.sort().values), test


def of_rssi(parts: Iterator[Part]) -> Iterator[Row]:
    """Yield the covered fractions of detected values and of positions."""
    for name, split, seed, *rows in parts:
        train, test = (part.subset(part.detected.any(dim=1)) for part in rows)
        model = swiftwrf.RssiModel(validation=train.validation_for(split, test), seed=seed).fit(train)
        low, high = model.predict_detected(test).interval(LEVEL)
        inside = (test.rssi_dbm >= low) & (test.rssi_dbm <= high)
        yield f"{name} {split}, RSSI", seed, float(inside[test.detected].double().mean())
        options = {"split": split, "n_cells": N_CELLS, "seed": seed}
        found = LocateComparison(train, test, {}, options).fit(None, "posterior")
        error, radius = (found["estimate"] - found["truth"]).norm(dim=1), found["radius"][:, LEVELS.index(LEVEL)]
        yield f"{name} {split}, regions", seed, float((error <= radius).double().mean())


def of_spectra(parts: Iterator[Part]) -> Iterator[Row]:
    """Yield the covered fractions of pixels by each field model."""
    for name, split, seed, train, test in parts:
        validation = "block" if split == "block" else "random"
        for field in FIELDS[: 2 + (train.array is not None)]:  # the last one needs an array
            found = swiftwrf.make_model(field, validation=validation, seed=seed).fit(train).predict(test.position)
            yield f"{name} {split}, {field}", seed, float(covered(found.mean, found.std, test.spectrum).mean())


def of_positions(parts: Iterator[Part]) -> Iterator[Row]:
    """Yield the covered fractions of positions by a room of six planes."""
    for name, split, seed, train, test in parts:
        room = swiftwrf.make_model("geometry", beam_width=1, max_extra_planes=0, max_order=1).fit(train)
        found = swiftwrf.MatchedField(spacing=0.3, seed=seed).fit(train, room=room).locate(test)
        inside = (found.median - test.position).norm(dim=1) <= found.credible_radius(LEVEL)
        yield f"{name} {split}, regions", seed, float(inside.double().mean())


coarse_room = partial(swiftwrf.simulated_room, grid=swiftwrf.AngularGrid.hemisphere(10, 40))
STUDIES: dict[Study, Callable[[Config], Iterator[Row]]] = {
    "floor": lambda config: of_rssi(simulated(config, swiftwrf.rssi_room)),
    "room": lambda config: of_spectra(simulated(config, swiftwrf.simulated_room)),
    "matched": lambda config: of_positions(simulated(config, coarse_room, N_SPECTRA, SEEDED[:1])),
    "rssi": lambda config: of_rssi(public(config, lambda folder: swiftwrf.load_rssi(folder).receivers(["all"]), RSSI)),
    "spectra": lambda config: of_spectra(public(config, swiftwrf.load_spectra, SPECTRA)),
}


if __name__ == "__main__":
    main(options(Config))
