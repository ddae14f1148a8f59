"""Measure updates: speed, alarms and adaptation after a box appeared in the built-in room, false alarms, and walks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from record import kept, options, write_result
from rooms import room_with_box

import swiftwrf
from swiftwrf import AngularGrid, Rssi, RssiModel, Spectra, rssi_room, simulated_room
from swiftwrf.contrib.online import Follower, Scores, adapted, prequential, score
from swiftwrf.data import load_rssi
from swiftwrf.metrics import psnr

Part = Literal["spectra", "rssi", "change", "unchanged", "tracks"]
PLACES = ((1.6, 2.4), (4.8, 2.0), (3.2, 0.9))  # centres of boxes [m]
MOBILITIES = ("transmitter", "receiver")
N_BEFORE, N_AFTER, N_TEST, N_UNCHANGED = 72, 72, 100, 1000
LEARNT = (10, 20, 40, 72)  # measurements after the change
SEEDS = {"before": 100, "after": 101, "test": 102, "unchanged": 103}
TRACK_TRAINING = 0.4  # of the rows of the walks, the first ones
BLOCK = 25  # consecutive rows that a bootstrap draws together
REPEATS = 7


@dataclass(frozen=True)
class Config:
    only: tuple[Part, ...] = get_args(Part)
    """parts to measure; the others are kept"""
    tracks: str | None = None
    """folder of RSSI along walks, in the order of the walks; without it that part is left out"""
    n_spectra: int = 1000
    """training spectra of the measurement of speed"""
    n_rows: int = 5000
    """training rows of the measurement of speed"""


def milliseconds(action: Callable[[int], object]) -> dict[str, float]:
    """Return the least and the median wall time of an action [ms]."""
    found = []
    for number in range(REPEATS):
        began = time.perf_counter()
        action(number)
        found.append(1000 * (time.perf_counter() - began))
    return {"least_ms": min(found), "median_ms": sorted(found)[REPEATS // 2]}


def spectra(config: Config) -> list[dict[str, Any]]:
    """Measure the update of field models by one spectrum, beside a fit and a regression with the same kernel."""
    n, rows = config.n_spectra, []
    data = simulated_room(n=n + REPEATS + 1, grid=AngularGrid.hemisphere(90, 360))
    for name in ("coarray", "swiftwrf"):
        began = time.perf_counter()
        fitted: Any = swiftwrf.make_model(name).fit(data.subset(torch.arange(n)))
        fit = time.perf_counter() - began
        model = fitted.update(data.subset(torch.tensor([n + REPEATS])))
        new = [data.subset(torch.tensor([n + number])) for number in range(REPEATS)]
        found = milliseconds(lambda number, model=model, new=new: model.update(new[number]))
        process = model.process
        again = milliseconds(lambda _, process=process: process.with_kernel(process.kernel).coefficient)
        rows.append({"model": name, "spectra": n, "fit_s": fit, "regression_ms": again["least_ms"], **found})
        print(rows[-1], flush=True)
    return rows


def rssi(config: Config) -> list[dict[str, Any]]:
    """Measure the update of an RSSI model by one row, beside a fit."""
    n = config.n_rows
    data = rssi_room(n=n + REPEATS + 1)
    began = time.perf_counter()
    fitted = RssiModel().fit(data.subset(torch.arange(n)))
    fit = time.perf_counter() - began
    began = time.perf_counter()
    model = fitted.update(data.subset(torch.tensor([n + REPEATS])))
    first = time.perf_counter() - began
    found = milliseconds(lambda number: model.update(data.subset(torch.tensor([n + number]))))
    return [{"rows": n, "bins": len(fitted.region()), "fit_s": fit, "first_update_s": first, **found}]


def scene(moving: Any, part: str, n: int, place: tuple[float, float] | None = None) -> Spectra:
    """Return spectra of the built-in room, with a box at a place."""
    return simulated_room(n=n, moving=moving, seed=SEEDS[part], room=room_with_box(place) if place else None)


def alarms(model: Any, train: Spectra, new: Spectra) -> Iterator[int]:
    """Follow spectra one by one. Yield their number at each alarm, of a room when it no longer explains them."""
    follower = Follower(model, train)
    has_room = follower.room is not None
    for i in range(len(new)):
        test = follower.room
        step = follower.step(new.subset(torch.tensor([i])))
        if follower.room is not test if has_room else step.alarms:  # the test of a room ends with its alarm
            yield i + 1


def change(config: Config) -> list[dict[str, Any]]:
    """Measure the number of spectra until an alarm, and the PSNR at unseen positions, after a box appeared."""
    rows = []
    for moving in MOBILITIES:
        before = scene(moving, "before", N_BEFORE)
        model: Any = swiftwrf.make_model("coarray").fit(before)
        room = swiftwrf.make_model("geometry").fit(before)
        for place in PLACES:
            after, test = scene(moving, "after", N_AFTER, place), scene(moving, "test", N_TEST, place)
            row: dict[str, Any] = {"moving": moving, "place": place}
            row["alarm_after"] = {m.name: next(alarms(m, before, after), None) for m in (model, room)}
            for n in LEARNT:
                some = after.subset(torch.arange(n))
                alone = swiftwrf.make_model("coarray").fit(some)
                adapted_model, correlation = adapted(model, some)
                models = {"stale": model, "update": model.update(some), "adapted": adapted_model, "alone": alone}
                mean = {k: float(psnr(m.synthesize(test.position), test.spectrum).mean()) for k, m in models.items()}
                row[f"psnr_db_{n}"] = {**mean, "correlation": correlation}
            rows.append(row)
            print(row, flush=True)
    return rows


def unchanged(config: Config) -> list[dict[str, Any]]:
    """Count the false alarms among spectra of the unchanged room."""
    rows = []
    for moving in MOBILITIES:
        before, new = scene(moving, "before", N_BEFORE), scene(moving, "unchanged", N_UNCHANGED)
        models = [swiftwrf.make_model(name).fit(before) for name in ("coarray", "geometry")]
        found = {model.name: len(list(alarms(model, before, new))) for model in models}
        rows.append({"moving": moving, "spectra": len(new), "alarms": found})
        print(rows[-1], flush=True)
    return rows


def tracks(config: Config) -> list[dict[str, Any]]:
    """Measure prequential errors along walks, of a model that learns beside one that does not."""
    assert config.tracks is not None
    data: Rssi = load_rssi(config.tracks)
    n = int(TRACK_TRAINING * len(data))
    new = data.subset(torch.arange(n, len(data)))
    model = RssiModel().fit(data.subset(torch.arange(n)))
    stale = score(model, new)
    learning, _ = prequential(model, new)
    change = learning.error - stale.error
    blocks = change[: len(change) // BLOCK * BLOCK].reshape(-1, BLOCK).nanmean(dim=1)
    draws = torch.randint(len(blocks), (2000, len(blocks)), generator=torch.Generator().manual_seed(0))
    low, high = blocks[draws].mean(dim=1).quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()

    def summary(scores: Scores) -> dict[str, Any]:
        quarters = [float(part.nanmean()) for part in scores.error.chunk(4)]
        return {
            "mae_db": float(scores.error.nanmean()),
            "quarters_db": quarters,
            "coverage": float(scores.covered.nanmean()),
        }

    row = {
        "name": data.name,
        "training_rows": n,
        "rows": len(new),
        "stale": summary(stale),
        "learning": summary(learning),
        "change_db": {"mean": float(change.nanmean()), "low": low, "high": high},
    }
    return [row]


def main(config: Config) -> None:
    """Measure each part and write `results/update.json`."""
    found: dict[str, list[dict[str, Any]]] = {part: kept("update", part) for part in get_args(Part)}
    for part in config.only:
        if part == "tracks" and config.tracks is None:
            continue
        found[part] = globals()[part](config)
        write_result("update", {"threads": torch.get_num_threads(), **found}, rows=found[part])


if __name__ == "__main__":
    main(options(Config))
