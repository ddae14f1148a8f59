"""Held-out PSNR of field models whose room was found with the held-out spectra, beside that of searches without them.

python benchmarks/held_out_rooms.py --data /data/newrf-bedroom /data/newrf-office

`searched` has a room for each pair of folds, found without it. `decided` has the planes that all measured spectra show;
which exist, where, and what stands in the room follows without the pair. `test` is the PSNR of a fit to all measured spectra
at test positions, which no fit used. `no room` are spectra of the built-in room at positions of others.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from record import options, write_result

from augment import choose_model, withhold
from augment.choose import blind_folds, without
from swiftwrf import GeometryModel, Spectra, load_spectra, make_model, simulated_room
from swiftwrf.metrics import psnr
from swiftwrf.models.base import synthesized

MODELS = ("geometry", "hybrid", "gp")


@dataclass(frozen=True)
class Config:
    data: tuple[Path, ...] = ()
    """measured or traced scenes, of which a tenth of the training spectra count as measured"""
    seeds: int = 5
    """seeds of the built-in room, at a tenth and at three tenths"""


def scenes(config: Config) -> Iterator[tuple[str, int, Spectra, Spectra]]:
    """Yield the name, the seed, the measured and the test spectra of each scene."""
    for seed in range(config.seeds):
        train, test = simulated_room(seed=seed).split("random", seed)
        for fraction in (0.1, 0.3):
            measured, _ = withhold(train, fraction, seed)
            yield f"simulated-room, {len(measured)} spectra", seed, measured, test
        order = torch.randperm(len(measured), generator=torch.Generator().manual_seed(seed))
        yield f"no room, {len(measured)} spectra", seed, replace(measured, position=measured.position[order]), test
    for folder in config.data:
        train, test = load_spectra(folder).split("random", 0)
        yield folder.name, 0, withhold(train, 0.1, 0)[0], test


def compared(seed: int, measured: Spectra, test: Spectra) -> dict[str, Any]:
    """Return planes, seconds and held-out PSNR of both ways, and the PSNR at test positions."""

    def search(spectra: Spectra) -> GeometryModel:
        return GeometryModel(seed=seed, validation="random").fit(spectra)

    fold, blind = blind_folds(measured, "random", seed)
    parts, whole, found = [measured.subset(without(fold, *numbers)) for numbers in blind], search(measured), {}
    ways = {"searched": search, "decided": whole.decided_on}
    for way, room_of in ways.items():
        rooms = []
        for part in parts:
            began = time.process_time()
            room = room_of(part)
            rooms.append((room, time.process_time() - began))
        choice = choose_model(measured, MODELS, seed=seed, structures=rooms)
        planes, seconds = [len(room.planes) for room, _ in rooms], [seconds for _, seconds in rooms]
        found[way] = {"planes": planes, "seconds": seconds, "psnr_db": choice.psnr_db, "chosen": choice.name}
    fits = {name: make_model(name, seed=seed, validation="random") for name in MODELS}
    fits = {name: fit.fit(measured, like=None if name == "gp" else whole) for name, fit in fits.items()}
    reached = {name: float(psnr(synthesized(fit, test.position), test.spectrum).mean()) for name, fit in fits.items()}
    return found | {"planes": len(whole.planes), "test": reached}


def main(config: Config) -> None:
    """Compare both ways on each scene and write `results/held_out_rooms.json`."""
    torch.set_num_threads(1)
    rows = []
    for scene, seed, measured, test in scenes(config):
        rows.append({"scene": scene, "seed": seed, "n": len(measured), **compared(seed, measured, test)})
        print(rows[-1], flush=True)
    write_result("held_out_rooms", {"scenes": rows})


if __name__ == "__main__":
    main(options(Config))
