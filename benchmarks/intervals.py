"""Measure which fraction of measured values lies in the 80 % intervals and regions that the models promise.

python benchmarks/intervals.py --data DATA

floor: intervals of `RssiModel` and regions of `RssiLocator` on simulated floors.
room: intervals of field models in the simulated room.
matched: regions of `MatchedField` in the simulated room.
rssi: intervals and regions as on the floors, on public data sets.
spectra: intervals of field models on public data sets.

Test rows of simulated data are at new positions in the region (random), or in a region of their own (block). The rules of
intervals were chosen on seeds from 100. Rows that were measured before and not again stay in the result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from record import kept, options, write_result

from swiftwrf import (
    AngularGrid,
    MatchedField,
    Rssi,
    RssiModel,
    Spectra,
    load_rssi,
    load_spectra,
    make_model,
    rssi_room,
    simulated_room,
)
from swiftwrf.locate.baselines import LEVELS
from swiftwrf.locate.comparison import LocateSplit
from swiftwrf.metrics import LEVEL, covered

RESULT = "intervals"
Study = Literal["floor", "room", "matched", "rssi", "spectra"]
SEEDED = ("random", "block")
N_TEST = 400  # random test rows of simulated measurements
N_BLOCKS = 5  # of a block split, one for each seed
FIELDS = ("swiftwrf", "gp", "coarray")
RSSI = {
    "tetam-tracks": ("random", "block", "spatial"),
    "tetam-fingerprints": ("random", "spatial"),
    "kolak": ("random", "block", "spatial"),
    "lora-campus": ("random", "foot"),
    **dict.fromkeys(("wifi-rooms/office", "wifi-rooms/lecture-theatre", "wifi-rooms/corridor", "gsm-recife"), SEEDED),
    **dict.fromkeys(("dae-2025", "ts-dsi1", "ts-tut2", "ts-tut5", "ts-ujib1"), ("published",)),
}
SPECTRA = {
    **dict.fromkeys(("s23-200", "newrf-bedroom", "newrf-conference", "newrf-office"), SEEDED),
    **{f"wsr-{sight}-a-tx{number}": ("place",) for sight in ("los", "nlos") for number in (2, 3, 4)},
}
Part = tuple[str, str, int, Rssi | Spectra, Rssi | Spectra]  # data set, split, seed, training and test rows
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
    positions: int = 200
    """training positions of simulated measurements"""
    spectra: int = 80
    """training spectra of regions by spectra"""
    rows: int = 1000
    """training rows of a public data set at most, random ones"""
    cells: int = 2000
    """candidate positions of regions by RSSI"""


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


def simulated(config: Config, make: Callable[[int], Rssi | Spectra], splits: Sequence[str] = SEEDED) -> Iterator[Part]:
    """Yield parts of simulated measurements."""
    for seed in range(config.first, config.first + config.seeds):
        data, some = make(seed), torch.arange(config.positions)
        for split in splits:
            new = data.subset(some), data.subset(torch.arange(config.positions, len(data)))
            yield data.name, split, seed, *(new if split == "random" else data.subset(some).split(split, seed))


def public(config: Config, read: Callable[[Path], Rssi | Spectra], sets: dict[str, Sequence[str]]) -> Iterator[Part]:
    """Yield parts of public data sets, of all seeds of splits that do not come with them."""
    for name, splits in sets.items():
        data = read(config.data / name)
        for split in splits:
            for seed in range(1 if split in data.named_splits else N_BLOCKS):
                train, test = data.split(split, seed)
                some = torch.randperm(len(train), generator=torch.Generator().manual_seed(seed))[: config.rows]
                yield name, split, seed, train.subset(some.sort().values), test


def of_rssi(config: Config, parts: Iterator[Part]) -> Iterator[Row]:
    """Yield the covered fractions of detected values and of positions."""
    for name, split, seed, *rows in parts:
        train, test = (part.subset(part.detected.any(dim=1)) for part in rows)
        model = RssiModel(validation=train.validation_for(split, test), seed=seed).fit(train)
        low, high = model.predict_detected(test).interval(LEVEL)
        inside = (test.rssi_dbm >= low) & (test.rssi_dbm <= high)
        yield f"{name} {split}, RSSI", seed, float(inside[test.detected].double().mean())
        values = LocateSplit(train, test, split, config.cells, seed, 0).fit(None, "posterior")
        error, radius = (values["estimate"] - values["truth"]).norm(dim=1), values["radius"][:, LEVELS.index(LEVEL)]
        yield f"{name} {split}, regions", seed, float((error <= radius).double().mean())


def of_spectra(parts: Iterator[Part]) -> Iterator[Row]:
    """Yield the covered fractions of pixels by each field model."""
    for name, split, seed, train, test in parts:
        for field in FIELDS[: 2 + (train.array is not None)]:  # the last one needs an array
            model = make_model(field, validation="block" if split == "block" else "random", seed=seed).fit(train)
            prediction = model.predict(test.position)
            fraction = covered(prediction.mean, prediction.std, test.spectrum).mean()
            yield f"{name} {split}, {field}", seed, float(fraction)


def of_positions(parts: Iterator[Part]) -> Iterator[Row]:
    """Yield the covered fractions of positions by a room of six planes."""
    for name, split, seed, train, test in parts:
        room = make_model("geometry", beam_width=1, max_extra_planes=0, max_order=1).fit(train)
        found = MatchedField(spacing=0.3, seed=seed).fit(train, room=room).locate(test)
        inside = (found.median - test.position).norm(dim=1) <= found.credible_radius(LEVEL)
        yield f"{name} {split}, regions", seed, float(inside.double().mean())


def floor(config: Config) -> Iterator[Row]:
    return of_rssi(config, simulated(config, lambda seed: rssi_room(config.positions + N_TEST, seed)))


def room(config: Config) -> Iterator[Row]:
    return of_spectra(simulated(config, lambda seed: simulated_room(n=config.positions + N_TEST, seed=seed)))


def matched(config: Config) -> Iterator[Row]:
    config, grid = replace(config, positions=config.spectra), AngularGrid.hemisphere(10, 40)
    rooms = simulated(config, lambda seed: simulated_room(n=config.spectra + N_TEST, seed=seed, grid=grid), SEEDED[:1])
    return of_positions(rooms)


STUDIES: dict[Study, Callable[[Config], Iterator[Row]]] = {
    "floor": floor,
    "room": room,
    "matched": matched,
    "rssi": lambda config: of_rssi(config, public(config, load_rssi, RSSI)),
    "spectra": lambda config: of_spectra(public(config, load_spectra, SPECTRA)),
}


if __name__ == "__main__":
    main(options(Config))
