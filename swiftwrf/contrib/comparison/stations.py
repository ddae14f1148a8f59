"""Comparison of localizers by several stations: each is fitted to the training transmissions and locates the test ones."""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pandas import DataFrame
from torch import Tensor

from swiftwrf.contrib.comparison.base import Recorded, Values
from swiftwrf.contrib.comparison.localizers import LEVELS, Located
from swiftwrf.contrib.comparison.locating import PositionComparison
from swiftwrf.contrib.comparison.station_localizers import STATION_LOCALIZERS, StationsPosterior
from swiftwrf.contrib.comparison.steps import LOCATOR, Memo, Steps
from swiftwrf.data import Stations
from swiftwrf.errors import InputError
from swiftwrf.locate import MatchedField, MatchedFieldConfig
from swiftwrf.locate.matched_field import MIN_SPECTRA
from swiftwrf.locate.posterior import Posterior
from swiftwrf.locate.triangulation import bearings, peak_directions, station_positions, triangulated
from swiftwrf.metrics import LEVEL, angle_errors
from swiftwrf.models.geometry import GeometryModel
from swiftwrf.models.geometry.agreement import agreed
from swiftwrf.runtime.checkpoint import load
from swiftwrf.runtime.validation import checked

ALONE = "posterior by "  # and the name of the station, of the posterior given the spectra of one station
MATCHED = "triangulation_matched"  # of the directions by these posteriors


@dataclass(frozen=True, eq=False, repr=False)
class StationsComparison(PositionComparison):
    """Result of `compare_stations`.

    Args:
        train: Training transmissions.
        test: Test transmissions.
        values: What `fit` gave, by localizer.
        options: The split and the seed.
        locator: Locator of all training transmissions.
        rooms: Known rooms of stations, which are not searched.
        config: Options of the posteriors.
    """

    received_by = "station"

    train: Stations
    test: Stations
    locator: MatchedField | None = None
    rooms: Mapping[str, GeometryModel] = field(default_factory=dict)
    config: MatchedFieldConfig = field(default_factory=MatchedFieldConfig)

    @classmethod
    def of_stations(cls, data: Stations, split: str, seed: int) -> StationsComparison:
        """Return a split of the transmissions without values; the arguments are those of `compare_stations`.

        Raises:
            InputError: No such split, or a station that received too few training transmissions.
        """
        train, test = data.split(split, seed)
        for name, count in zip(train.names, train.received.sum(dim=0).tolist(), strict=True):
            if count < MIN_SPECTRA:
                raise InputError(
                    f"station {name} of {data.name} received {count} training transmissions of split {split!r}; at least "
                    f"{MIN_SPECTRA} are needed to locate by"
                )
        return cls(train, test, {}, {"split": split, "seed": seed})

    def room(self, folder: Path, station: str) -> Values:
        """Search the room of a station, unless it is known, and save it in a folder."""
        began = time.perf_counter()
        model = self.rooms.get(station)
        if model is None:
            model = GeometryModel(seed=self.options["seed"]).fit(self.train.of(station)[1], progress=True)
        model.save(_room_file(folder, station))
        return {"conclusion": model.estimate.conclusion, "seconds": time.perf_counter() - began}

    def fit(self, folder: Path | None, name: str) -> Values:
        """Fit a localizer with the rooms in a folder, and locate the test transmissions. Return its values."""
        assert folder is not None
        train, test, kind = self.train, self.test, name
        if name.startswith(ALONE):
            kind = self.model
            train, test = (data.only(name.removeprefix(ALONE)) for data in (train, test))
        rooms = {station: _room(folder, station) for station in train.names}
        localizer = STATION_LOCALIZERS[kind](rooms, replace(self.config, seed=self.options["seed"]))
        began = time.perf_counter()
        localizer.fit(train)
        fitted = time.perf_counter()
        located = localizer.locate(test)
        values = self._values(located, fitted - began, time.perf_counter() - fitted)
        if isinstance(localizer, StationsPosterior):
            values["weights"] = localizer.weights()
            if name == self.model:
                localizer.locator.save(folder / LOCATOR)
        return values

    def agree(self, folder: Path) -> Values:
        """Let the rooms in a folder agree."""
        began = time.perf_counter()
        rooms = {name: _room(folder, name) for name in self.train.names}
        for name, room in agreed(rooms, {name: self.train.of(name)[1] for name in rooms}).items():
            room.save(_room_file(folder, name))
        return {"seconds": time.perf_counter() - began}

    def triangulate(self, _: Path | None, directions: Mapping[str, Any]) -> Values:
        """Triangulate the directions (n, 2) [rad] of the test transmissions by the posterior at each station alone."""
        began = time.perf_counter()
        known = {
            name: torch.as_tensor(values, dtype=torch.float64)[self.test.of(name)[0]]
            for name, values in directions.items()
        }
        mean = self.train.position.mean(dim=0)
        position = triangulated(*bearings(self.test, known, mean), start=mean)
        return self._values(Located(position), 0.0, time.perf_counter() - began)

    @property
    def directions(self) -> DataFrame:
        """Median angular errors at each station [deg]: of the posterior, of that by this station alone, and of the peak."""
        peaks, rows = peak_directions(self.test), []
        estimate = torch.as_tensor(self.values[self.model]["direction"], dtype=torch.float64)
        for number, name in enumerate(self.test.names):
            received, spectra = self.test.of(name)
            alone = torch.as_tensor(self.values[ALONE + name]["direction"], dtype=torch.float64)[received, 0]
            by = {"posterior": estimate[received, number], "alone": alone, "peak": peaks[name]}
            errors = {kind: angle_errors(each, spectra.label)["great_circle"] for kind, each in by.items()}
            medians = {f"{kind}_deg": float(error.rad2deg().quantile(0.5)) for kind, error in errors.items()}
            rows.append({"station": name, "received": len(received), **medians})
        return DataFrame(rows)

    @property
    def receivers(self) -> list[str]:
        """Names of the stations."""
        return self.train.names

    @property
    def notes(self) -> list[str]:
        """Sentences on the data and on what stations received."""
        counts = self.train.received.sum(dim=0) + self.test.received.sum(dim=0)
        total = len(self.train) + len(self.test)
        named = [
            f"{name} {count}" for name, count in zip(self.train.names, counts.tolist(), strict=True) if count < total
        ]
        missed = [f"of {total} transmissions, stations received: {', '.join(named)}"] if named else []
        return [*missed, *self.train.notes]

    def recorded(self) -> Recorded:
        found = super().recorded()
        return replace(found, tables={**found.tables, "directions": self.directions})

    def _maps(self) -> dict[str, Any]:
        maps = super()._maps()
        row = {number: n for n, number in enumerate(self.test.index.tolist())}
        shown = [row[number] for number in maps["index"].tolist()]
        alone = [self.values[ALONE + name] for name in self.test.names]
        return maps | {
            "stations": station_positions(self.train).numpy(),
            "alone_estimate": np.array([np.array(each["estimate"])[shown] for each in alone]),
            "alone_radius_80_m": np.array([np.array(each["radius"])[shown, LEVELS.index(LEVEL)] for each in alone]),
        }

    def _positions(self) -> tuple[Tensor, Tensor]:
        return self.train.position, self.test.position

    def _extent(self) -> Tensor:
        return torch.cat([self.train.position, self.test.position, station_positions(self.train)])

    def _posterior(self, rows: NDArray[np.int64]) -> Posterior:
        assert self.locator is not None
        return self.locator.locate(self.test.subset(rows))


def _room_file(folder: Path, station: str) -> Path:
    return folder / f"room-{station}.safetensors"


def _room(folder: Path, station: str) -> GeometryModel:
    found = load(_room_file(folder, station))
    assert isinstance(found, GeometryModel)
    return found


@checked
def compare_stations(
    data: Stations,
    *,
    split: str = "random",
    seed: int = 0,
    rooms: Mapping[str, GeometryModel] | None = None,
    config: MatchedFieldConfig | None = None,
    keep: Memo | None = None,
    executor: Executor | None = None,
) -> StationsComparison:
    """Fit every localizer by several stations to the training transmissions of a split, and locate the test transmissions.

    Args:
        data: Spectra of the stations, each with array, position and orientation.
        split: Split that comes with the data, or a seeded one: random or block.
        seed: Seed of everything random.
        rooms: Known rooms of all stations. Defaults to a search for the room of each, which then agree about their planes.
        config: Options of the posteriors, of which the seed does not count. Defaults to those of `MatchedField`.
        keep: Results by the names of steps, in a folder, as of `compare`.
        executor: Processes that compute steps side by side, e.g. a `ProcessPoolExecutor`.

    Raises:
        InputError: No such split, too few transmissions, stations without pose, or `keep` of another call.

    Example:
        >>> import swiftwrf
        >>> from swiftwrf.models.geometry import Plane
        >>> data = swiftwrf.simulated_stations(n=40, stations=2, grid=swiftwrf.AngularGrid.hemisphere(9, 36))
        >>> floor = Plane((0.0, 0.0, -1.0), 0.0, -0.6)
        >>> rooms = {name: GeometryModel.of_planes(data.of(name)[1], [floor]) for name in data.names}
        >>> quick = MatchedFieldConfig(max_cells=1000, n_best=50, n_background=20, n_rounds=1)
        >>> result = compare_stations(data, rooms=rooms, config=quick)
        >>> list(result.values)[:4]
        ['posterior', 'triangulation', 'knn', 'mean']
    """
    given = locals().copy()
    begun = replace(
        StationsComparison.of_stations(data, split, seed), rooms=rooms or {}, config=config or MatchedFieldConfig()
    )
    if keep is not None:
        keep.of(given | {"localizers": [STATION_LOCALIZERS[name] for name in STATION_LOCALIZERS]})
    memo = keep or Memo()
    steps = Steps(begun, memo, executor)
    alone, agrees = [ALONE + name for name in data.names], len(data.names) > 1 and not rooms
    steps.expect(len(data.names) + agrees + len(STATION_LOCALIZERS) + len(alone) + 1)
    searches = [
        steps.start(f"room {name}", f"finding the room of {name}", StationsComparison.room, name) for name in data.names
    ]
    for name in searches:
        steps[name]
    if agrees:
        steps[steps.start("rooms agree", "one room for all stations", StationsComparison.agree)]
    started = [
        steps.start(name, f"locating by {name}", StationsComparison.fit, name) for name in [*STATION_LOCALIZERS, *alone]
    ]
    values = {name: steps[name] for name in started}
    directions = {name: [row[0] for row in values[ALONE + name]["direction"]] for name in data.names}
    values[MATCHED] = steps[steps.start(MATCHED, f"locating by {MATCHED}", StationsComparison.triangulate, directions)]
    locator = load(memo.folder / LOCATOR)
    assert isinstance(locator, MatchedField)
    return replace(begun, values=values, locator=locator)
