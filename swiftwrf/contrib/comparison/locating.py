"""Comparison of localizers: each is fitted to the training rows of a split and locates the test rows."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pandas import DataFrame
from torch import Tensor

from swiftwrf.contrib.comparison.base import Comparison, Recorded, Values
from swiftwrf.contrib.comparison.errors import summary
from swiftwrf.contrib.comparison.localizers import LEVELS, LOCALIZERS, Localizer, Located, PosteriorLocalizer
from swiftwrf.contrib.comparison.steps import LOCATOR, Memo, Steps
from swiftwrf.data import Rssi
from swiftwrf.data.coordinates import Floors, GeodeticOrigin, degree_columns
from swiftwrf.data.rooms import Rooms
from swiftwrf.data.rssi import PLACE
from swiftwrf.data.splits import places
from swiftwrf.errors import InputError
from swiftwrf.locate.locator import Locator
from swiftwrf.locate.posterior import Posterior
from swiftwrf.locate.rssi import BATCH_ROWS, RssiLocator
from swiftwrf.metrics import LEVEL
from swiftwrf.rssi import estimate_offsets
from swiftwrf.runtime.checkpoint import load
from swiftwrf.runtime.validation import checked

MIN_ROWS = 20  # training rows that a receiver detected: five folds, of which four hold at least 10 rows
OPTIONAL = ("radius", "ambiguous", "floor_probability", "direction")  # of `Located`, which some localizers give
N_MAPS = 6  # test rows whose posteriors are drawn


@dataclass(frozen=True, eq=False, repr=False)
class PositionComparison(Comparison):
    """Localizers that were fitted to the training rows of a split, and their position errors on its test rows.

    Args:
        locator: Locator of all training rows.
    """

    task = "locate"
    column = "position_error_m"
    further = ("horizontal_error_m",)
    model = "posterior"
    received_by: ClassVar[str] = "receiver"
    """what receives the transmitter"""

    locator: Locator | None = None

    @property
    @abstractmethod
    def receivers(self) -> Sequence[str]:
        """Names of the receivers or stations."""

    @property
    def floors(self) -> Floors | None:
        """Floors of the building. None if there is one only."""
        return None

    @property
    def origin(self) -> GeodeticOrigin | None:
        """Origin of the coordinates. None if they have no degrees."""
        return None

    @abstractmethod
    def _positions(self) -> tuple[Tensor, Tensor]:
        """Return the training and the test positions, (n, 3) [m]."""

    def _values(self, located: Located, fit_s: float, predict_s: float) -> Values:
        """Return the values of a localizer from its positions of the test rows, and the seconds that it took."""
        _, truth = self._positions()
        values: Values = {
            "seconds": {"fit": fit_s, "predict": predict_s},
            "index": self.test.index,
            "truth": truth,
            "estimate": located.position,
            "median": summary((located.position - truth).norm(dim=1))["median"],
        }
        optional = {name: getattr(located, name) for name in OPTIONAL}
        return values | {name: value for name, value in optional.items() if value is not None}

    def _extent(self) -> Tensor | None:
        """Return positions whose extent maps of the posterior have, (n, 3) [m]. None if all have the same candidates."""
        return None

    @abstractmethod
    def _posterior(self, rows: NDArray[np.int64]) -> Posterior:
        """Return the posterior of test rows by the locator."""

    @property
    def coverage(self) -> dict[float, float]:
        """Fraction of the test positions in the credible regions of the posterior, by their probability."""
        own = self.errors[self.errors["method"] == self.model]
        return {p: float((own[self.column] <= own[_radius(p)]).mean()) for p in LEVELS}

    @property
    def overall(self) -> dict[str, Values]:
        """Position errors in space and in plan [m] of each localizer, its seconds, and its floor hit rate.

        The floor of an estimate is the one of the nearest height. Data without floors have no floor hit rate.
        """
        found = super().overall
        if self.floors is not None:
            for name, own in self.errors.groupby("method"):
                found[name]["floor_hit_rate"] = float((own["floor"] == own["truth_floor"]).mean())
        return found

    def recorded(self) -> Recorded:
        found = super().recorded()
        metrics = {
            "n_receivers": len(self.receivers),
            "received_by": self.received_by,
            "calibration": {str(level): fraction for level, fraction in self.coverage.items()},
            "weights": self.values[self.model]["weights"],
        }
        return replace(found, metrics=found.metrics | metrics, arrays={"maps": self._maps()})

    def _maps(self) -> dict[str, NDArray[Any]]:
        """Return posteriors in plan of at most six test rows, from the smallest error to the largest."""
        order = self.errors.loc[self.errors["method"] == self.model, self.column].to_numpy().argsort()
        shown = order[np.linspace(0, len(order) - 1, min(N_MAPS, len(order))).round().astype(int)]
        (train, test), posterior = self._positions(), self._posterior(shown)
        plans = [posterior.in_plan(row, self._extent()) for row in range(len(posterior))]
        return {
            "x": plans[0].x,
            "y": plans[0].y,
            "density": np.stack([plan.values for plan in plans]).astype(np.float32),
            "index": self.test.index[shown].numpy(),
            "truth": test[shown].numpy(),
            "estimate": posterior.median.numpy(),
            "radius_80_m": posterior.credible_radius(LEVEL).numpy(),
            "training_position": train.numpy(),
        }

    def _columns(self, name: str) -> Mapping[str, Any]:
        values = self.values[name]
        truth, estimate = (torch.as_tensor(values[name], dtype=torch.float64) for name in ("truth", "estimate"))
        away = estimate - truth
        columns: Values = {"index": values["index"], "place": places(truth, 2)}
        columns |= {"position_error_m": away.norm(dim=1), "horizontal_error_m": away[:, :2].norm(dim=1)}
        columns |= dict(zip(("x_m", "y_m", "z_m"), estimate.T, strict=True))
        columns |= dict(zip(("truth_x_m", "truth_y_m", "truth_z_m"), truth.T, strict=True))
        columns |= degree_columns(self.origin, estimate.numpy())
        if (floors := self.floors) is not None:
            columns["floor"], columns["truth_floor"] = (floors.named(at) for at in (estimate, truth))
        if "floor_probability" in values:
            columns["floor_probability"] = values["floor_probability"]
        if "radius" in values:
            radius = torch.as_tensor(values["radius"], dtype=torch.float64)
            columns |= {_radius(p): r for p, r in zip(LEVELS, radius.T, strict=True)}
            columns["ambiguous"] = values["ambiguous"]
        return columns


def _radius(level: float) -> str:
    return f"credible_radius_{100 * level:.0f}_m"


@dataclass(frozen=True, eq=False, repr=False)
class LocateComparison(PositionComparison):
    """Result of `compare`.

    Args:
        train: Training rows, without offsets between groups.
        test: Test rows that a receiver detected, without offsets between groups.
        values: What `fit` gave, by localizer.
        options: The split, the number of candidate positions of the posterior `n_cells`, and the seed.
        n_undetected: Number of test rows that no receiver detected, which are left out.
        locator: Locator of all training rows.
        rooms: Rooms whose probability is recorded for each test row.

    Example:
        >>> import swiftwrf
        >>> begun = LocateComparison.of(swiftwrf.rssi_room(n=60), "random", 100, 0)
        >>> len(replace(begun, values={"mean": begun.fit(None, "mean")}).errors)
        12
    """

    train: Rssi
    test: Rssi
    locator: RssiLocator | None = None
    n_undetected: int = 0
    own: Mapping[str, Localizer] = field(default_factory=dict)
    rooms: Rooms | None = None

    @classmethod
    def of(cls, data: Rssi, split: str, n_cells: int, seed: int, reference: str | None = None) -> LocateComparison:
        """Return a split of RSSI without values; the arguments are those of `compare`.

        Offsets between groups, if there are any, are estimated from training rows and removed.

        Raises:
            InputError: Receivers that move, no such split, one of other receivers in the test rows, or too few rows in which
                a receiver detected the transmitter.
        """
        if data.receiver_moves:
            raise InputError(
                f"both ends of {data.name} move; positions are found by receivers that stay where they are"
            )
        if split == PLACE and split not in data.named_splits:
            raise InputError(
                f"split {split!r} tests other receivers than it trains; choose random or block to locate by"
            )
        train, test = data.split(split, seed)
        detected = int(train.detected.any(dim=1).sum())
        if detected < MIN_ROWS:
            raise InputError(
                f"split {split!r} of {data.name} has {detected} training rows that a receiver detected; at least {MIN_ROWS} "
                "are needed to locate by"
            )
        kept = test.detected.any(dim=1)
        if not bool(kept.any()):
            raise InputError(f"split {split!r} of {data.name} has no test rows that a receiver detected")
        test = test.subset(kept)
        if train.groups is not None:
            offsets = estimate_offsets(train, reference)
            train, test = offsets.removed(train), offsets.removed(test)
        options = {"split": split, "n_cells": n_cells, "seed": seed}
        return cls(train, test, {}, options, n_undetected=int((~kept).sum()))

    def fit(self, folder: Path | None, name: str) -> Values:
        """Fit a localizer and locate the test rows. Return its values. A folder gets the locator.

        Folds resemble the test rows in their distances to the training positions, all that is used of the test positions.
        """
        train, test, split = self.train, self.test, self.options["split"]
        validation = train.validation_for(split, test)
        n_cells, seed = self.options["n_cells"], self.options["seed"]
        options: Values = {"validation": validation, "n_cells": n_cells, "seed": seed}
        localizer = deepcopy(self.own[name]) if name in self.own else LOCALIZERS[name](**options)
        began = time.perf_counter()
        localizer.fit(train)
        fitted = time.perf_counter()
        located = localizer.locate(test.rssi_dbm)
        values = self._values(located, fitted - began, time.perf_counter() - fitted)
        if isinstance(localizer, PosteriorLocalizer):
            weight = localizer.locator.weight.tolist()
            values["weights"] = dict(zip(("values", "detections", "fingerprints"), weight, strict=True))
            values["held_out"] = localizer.locator.held_out_m
            if folder is not None:
                localizer.locator.save(folder / LOCATOR)
        return values

    @property
    def receivers(self) -> Sequence[str]:
        return self.train.receiver_names

    @property
    def floors(self) -> Floors | None:
        return self.train.floors

    @property
    def origin(self) -> GeodeticOrigin | None:
        return self.train.origin

    def _positions(self) -> tuple[Tensor, Tensor]:
        return self.train.transmitter_position, self.test.transmitter_position

    def _posterior(self, rows: NDArray[np.int64]) -> Posterior:
        assert self.locator is not None
        return self.locator.locate(self.test.rssi_dbm[rows])

    def recorded(self) -> Recorded:
        found = super().recorded()
        metrics = {"n_undetected": self.n_undetected, "rooms": [] if self.rooms is None else list(self.rooms.names)}
        tables = dict(found.tables) if self.rooms is None else {**found.tables, "rooms": self._rooms(self.rooms)}
        return replace(found, metrics=found.metrics | metrics, tables=tables)

    def _rooms(self, rooms: Rooms) -> DataFrame:
        """Return the true room and the probability of each room, a row for each test row."""
        posteriors = map(
            self._posterior, np.split(np.arange(len(self.test)), range(BATCH_ROWS, len(self.test), BATCH_ROWS))
        )
        probability = torch.cat([rooms.probability(each.position, each.weight) for each in posteriors])
        truth = rooms.named(self.test.transmitter_position)
        return DataFrame({"index": self.test.index.numpy(), "truth_room": truth, **rooms.columns(probability)})


@checked
def compare(
    data: Rssi,
    *,
    receivers: Sequence[str] = ("all",),
    split: str = "random",
    seed: int = 0,
    n_cells: int = 4000,
    also: Mapping[str, Localizer] | None = None,
    reference: str | None = None,
    rooms: Rooms | None = None,
    keep: Memo | None = None,
    executor: Executor | None = None,
) -> LocateComparison:
    """Fit every localizer to the training rows of a split, and locate the test rows.

    Args:
        data: RSSI at receivers that stay where they are. Offsets between its groups, if it has any, are removed.
        receivers: Names of receivers, numbers counted from 1, or "all".
        split: Split that comes with the data, or a seeded one: random or block.
        seed: Seed of everything random.
        n_cells: Number of candidate positions of the posterior.
        also: Localizers of your own by their names, which stay as they are.
        reference: Group whose offset is 0. Defaults to the most frequent one.
        rooms: Rooms whose probability is recorded for each test row; see `swiftwrf.data.rooms.read_rooms`.
        keep: Results by the names of steps, in a folder. A call with equal data, options, code and versions continues
            after them, others are refused.
        executor: Processes that compute steps side by side, e.g. a `ProcessPoolExecutor`.

    Raises:
        InputError: Receivers that move, unknown receivers or split, too few rows that a receiver detected, or `keep` of
            another call.

    Example:
        >>> import swiftwrf
        >>> result = compare(swiftwrf.rssi_room(n=80), n_cells=300)
        >>> bool(result.summary().loc["posterior", "median"] < result.summary().loc["mean", "median"])
        True
    """
    given = {name: value for name, value in locals().items() if name != "rooms"}  # which change no step
    begun = LocateComparison.of(data.receivers(receivers), split, n_cells, seed, reference)
    own = dict(also or {})
    if known := sorted(own.keys() & set(LOCALIZERS)):
        raise InputError(f"also has a localizer {known[0]!r}, which is the name of another one; give it its own")
    if keep is not None:
        if own:
            raise InputError(
                "keep takes localizers by name; register those of your own as entry points, or leave it out"
            )
        keep.of(given | {"localizers": [LOCALIZERS[name] for name in LOCALIZERS]})
    begun = replace(begun, own=own)
    memo = keep or Memo()
    steps = Steps(begun, memo, executor)
    started = [steps.start(name, f"locating by {name}", LocateComparison.fit, name) for name in (*LOCALIZERS, *own)]
    values = {name: steps[name] for name in started}
    locator = load(memo.folder / LOCATOR)
    assert isinstance(locator, RssiLocator)
    return replace(begun, values=values, locator=locator, rooms=rooms)
