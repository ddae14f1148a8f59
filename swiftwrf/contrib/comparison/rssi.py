"""Comparison of RSSI predictors: each is fitted to the training rows of a split and predicts the test rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from pandas import DataFrame
from torch import Tensor

from swiftwrf.choices import RSSI_PREDICTORS, NotDetected
from swiftwrf.contrib.comparison.base import Comparison, Recorded, Values
from swiftwrf.contrib.comparison.coverage import maps_and_coverage
from swiftwrf.contrib.comparison.errors import summaries, summary
from swiftwrf.contrib.comparison.leave_one_out import LEAVE_ONE_OUT, distances_to_others, is_small
from swiftwrf.contrib.comparison.parts import pool_of
from swiftwrf.contrib.comparison.predictors import compared
from swiftwrf.contrib.comparison.rssi_fits import RssiFits
from swiftwrf.contrib.comparison.steps import MODEL, Memo, Steps, refusing_executor
from swiftwrf.data import Rssi
from swiftwrf.data.coordinates import degree_columns
from swiftwrf.data.rooms import Rooms
from swiftwrf.data.rssi import PLACE
from swiftwrf.data.splits import Validation, places
from swiftwrf.errors import InputError
from swiftwrf.metrics import LEVEL
from swiftwrf.models.prediction import Prediction
from swiftwrf.positions import distance, nearest
from swiftwrf.rssi.base import Map, RssiPredictor
from swiftwrf.rssi.coverage import default_threshold, smaller_is_better
from swiftwrf.rssi.model import RssiModel
from swiftwrf.rssi.offsets import estimate_offsets
from swiftwrf.rssi.pairs import PairModel
from swiftwrf.runtime.checkpoint import load
from swiftwrf.runtime.validation import Fraction, PositiveInt, Preset, checked

DISTANCES = ("from_receiver_m", "from_training_m")  # columns of the errors


@dataclass(frozen=True, eq=False, repr=False)
class RssiComparison(Comparison):
    """Result of `compare`.

    Args:
        train: Training rows, without offsets between groups.
        test: Test rows.
        values: What each predictor gave, by name: `predicted` at the detected test pairs (n,) [dBm], their standard
            deviations `std` (n,) [dB] or None, `median` absolute error [dB], `seconds` to `fit` and to `predict`.
            `detection` are the fractions of detected and of empty test cells that are predicted as such, or None. Predictors
            without primitives have 0 `n_primitives`.
        options: The split, the preset and the seed.
        left_out: Reason for each predictor that the data do not suffice for.
        predictors: Fitted predictors by name. Of those whose values `keep` had, or a worker found, the model alone.
        by_rows: Mean absolute errors [dB] of the model and of "knn" by the number of training rows, a column for each.
        above: Thresholds of the coverage [dBm]. Defaults to that of `default_threshold`.
        below: Thresholds where smaller is better, e.g. of latency, in place of `above`.
        region: Mean absolute errors [dB] of both in a fifth of the area, fitted to the training rows elsewhere.
        rooms: Rooms whose coverage is recorded.
        repeats: Median and mean absolute errors [dB] of each method by the `seed` of the split, a row each.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.rssi_room(n=60).split()
        >>> RssiComparison(train, test, {}, {}).model
        'swiftwrf'
    """

    task = "rssi"
    column = "abs_error_db"

    train: Rssi
    test: Rssi
    left_out: Mapping[str, str] = field(default_factory=dict)
    predictors: Mapping[str, RssiPredictor] = field(default_factory=dict)
    by_rows: DataFrame = field(default_factory=DataFrame)
    above: tuple[float, ...] = ()
    below: tuple[float, ...] = ()
    region: Mapping[str, float] = field(default_factory=dict)
    rooms: Rooms | None = None
    repeats: DataFrame = field(default_factory=DataFrame)

    @property
    def model(self) -> str:
        return PairModel.name if self.train.receiver_moves else RssiModel.name

    @property
    def thresholds(self) -> tuple[tuple[float, ...], str | None]:
        """Thresholds of the coverage [dBm], the first one that of maps, and the reason for a default."""
        default, reason = default_threshold(self.train)
        given = self.above or self.below
        return (given, None) if given else ((default,), reason)

    @property
    def is_below(self) -> bool:
        """True if values below the thresholds are covered: those of `below`, or the default where smaller is better."""
        return bool(self.below) or (not self.above and smaller_is_better(self.train.quantity))

    @cached_property
    def predictions(self) -> DataFrame:
        """Measured values, predictions and 80 % intervals of the model, a row for each detected test pair."""
        test, (row, column) = self.test, self._pairs
        prediction = self._prediction(self.model)
        low, high = prediction.interval(LEVEL)
        values = {"measured": test.rssi_dbm[row, column], "predicted": prediction.mean, "low": low, "high": high}
        table = DataFrame(test.transmitter_position[row].numpy().round(3), columns=["x", "y", "z"])
        group = {} if test.groups is None else {"group": test.groups.iloc[row.tolist()].tolist()}
        table = table.assign(receiver=self._receiver, **group)
        table = table.assign(**{name: value.numpy().round(2) for name, value in values.items()})
        return table.assign(**degree_columns(test.origin, test.transmitter_position[row].numpy()))

    @property
    def coverage(self) -> float:
        """Fraction of the detected test values inside the model's 80 % intervals."""
        measured, (low, high) = self.test.rssi_dbm[self._pairs], self._prediction(self.model).interval(LEVEL)
        return float(((measured >= low) & (measured <= high)).double().mean())

    def summary(self) -> DataFrame:
        """Return a row for each method: errors [dB], and their mean difference to those of `model`; see `method_summary`.

        `detection` is the balanced accuracy of predicting which test cells are empty, if there are empty ones: the mean of
        the fractions of detected and of empty cells that are predicted as such. With `repeats` there are mean and standard
        deviation of median and mean error over the splits.
        """
        table = super().summary()
        for name, column in self._over_repeats.items():
            table[name] = column
        right = {name: sum(value["detection"]) / 2 for name, value in self.values.items() if value.get("detection")}
        return table.assign(detection=table.index.map(right)) if right else table

    @property
    def _over_repeats(self) -> DataFrame:
        """Mean and standard deviation over splits of the median and the mean error, a row for each method."""
        if not len(self.repeats):
            return DataFrame()
        found = self.repeats.groupby("method", sort=False)[["median", "mean"]].agg(["mean", "std"])
        return found.set_axis([f"{error}_{kind}" for error, kind in found.columns], axis=1)

    @property
    def notes(self) -> list[str]:
        model, floors, notes = self._fitted, self.train.floors, super().notes
        if model.attenuation is not None and model.attenuation.db is not None and floors is not None:
            notes.append(f"each of the {len(floors.names)} floors attenuates by {model.attenuation.db:.1f} dB")
        return notes if model.detection is None else [*notes, model.detection.note(self.train.receiver_names)]

    def _columns(self, name: str) -> Mapping[str, Any]:
        predicted = self._prediction(name).mean
        error = (predicted - self._pair_columns["measured_dbm"]).abs()
        names = ("receiver", "index", "place", "measured_dbm", "predicted_dbm", self.column, *DISTANCES)
        columns = self._pair_columns | {"predicted_dbm": predicted, self.column: error}
        return {column: columns[column] for column in names}

    @cached_property
    def _pair_columns(self) -> dict[str, Any]:
        """Columns of the detected test pairs that are those of every method."""
        test, (row, column) = self.test, self._pairs
        from_receiver = distance(test.transmitter_position, test.receiver_position)[row, column]
        if self.options["split"] == LEAVE_ONE_OUT:
            from_training = distances_to_others(test.transmitter_position)[row]
        else:
            from_training = nearest(test.transmitter_position, self.train.transmitter_position, 1)[0][row, 0]
        return {
            "receiver": self._receiver,
            "index": test.index[row],
            "place": places(test.transmitter_position, 2)[row],
            "measured_dbm": test.rssi_dbm[row, column],
            **dict(zip(DISTANCES, (from_receiver, from_training), strict=True)),
        }

    @property
    def overall(self) -> dict[str, Values]:
        return {name: entry | {"detection": self.values[name]["detection"]} for name, entry in super().overall.items()}

    def recorded(self) -> Recorded:
        recorded, attenuation = super().recorded(), self._fitted.attenuation
        test = self.test if self.train.offsets is None else self.train.offsets.removed(self.test)
        covered = self.thresholds[0], self.rooms, self.is_below
        maps, coverage, tables = maps_and_coverage(self._fitted, self.train, test, *covered)
        at_receiver, none = summaries(self.errors, ["receiver", "method"], [self.column]), {self.column: summary([])}
        metrics = {
            "left_out": self.left_out,
            "receivers": {
                receiver: {name: at_receiver.get((receiver, name), none) for name in self.values}
                for receiver in self.test.receiver_names
            },
            "model": self.model,
            "quantity": self.train.quantity,
            "unit": self.train.unit,
            "seconds": self.values[self.model]["seconds"],
            "interval": {"nominal": LEVEL, "coverage": self.coverage},
            "coverage": coverage,
            "threshold": self.thresholds[1],
            "repeats": self._over_repeats.assign(
                n=self.repeats["seed"].nunique() if len(self.repeats) else 0
            ).T.to_dict(),
            "bands": tables["bands"].to_dict("records") if "bands" in tables else [],
            "rooms": [] if self.rooms is None else list(self.rooms.names),
            "by_rows": {str(n): {str(name): mean for name, mean in row.items()} for n, row in self.by_rows.iterrows()},
            "region": dict(self.region),
            "chosen": {
                "n_primitives": max(value["n_primitives"] for value in self.values.values()),
                "floor_attenuation_db": None if attenuation is None else attenuation.db,
            },
        }
        tables |= {"errors": self.errors, "predictions": self.predictions}
        named = {kind: f"{kind}_{self.column}" for kind in ("median", "mean")}
        tables |= {"repeats": self.repeats.rename(columns=named)} if len(self.repeats) else {}
        return replace(recorded, metrics=recorded.metrics | metrics, tables=tables, arrays={"maps": maps})

    @property
    def _fitted(self) -> RssiModel | PairModel:
        model = self.predictors[self.model]
        assert isinstance(model, RssiModel | PairModel)
        return model

    @property
    def _pairs(self) -> tuple[Tensor, Tensor]:
        """Rows and receivers of the detected test pairs."""
        row, column = self.test.detected.nonzero(as_tuple=True)
        return row, column

    @property
    def _receiver(self) -> list[str]:
        return [self.test.receiver_names[number] for number in self._pairs[1].tolist()]

    def _prediction(self, name: str) -> Prediction:
        """Return the prediction of the detected test pairs (n,), with the offsets of their groups."""
        values, offsets = self.values[name], self.train.offsets
        mean = torch.as_tensor(values["predicted"], dtype=torch.float64)
        if offsets is not None:
            mean = mean + offsets.of(self.test)[self._pairs[0]]
        std = None if values["std"] is None else torch.as_tensor(values["std"], dtype=torch.float64)
        return Prediction(mean, std)


@checked
def compare(
    data: Rssi,
    *,
    receivers: Sequence[str] = ("all",),
    split: str = "random",
    seed: int = 0,
    also: Sequence[str | RssiPredictor] = (),
    only: Sequence[str] = (),
    preset: Preset = "quick",
    reference: str | None = None,
    not_detected: NotDetected = "auto",
    validation: Validation | Literal["auto"] = "auto",
    fewer: Sequence[Fraction] = (),
    repeats: PositiveInt = 1,
    above: Sequence[float] = (),
    below: Sequence[float] = (),
    rooms: Rooms | None = None,
    device: torch.device | str = "cpu",
    keep: Memo | None = None,
    executor: Executor | None = None,
    parallel: Map | None = None,
    progress: bool = False,
) -> RssiComparison:
    """Fit every predictor to the training rows of a split, and predict the test rows.

    Args:
        data: RSSI. Offsets between its groups, if it has any, are estimated from training rows and removed from them.
        receivers: Names of receivers, numbers counted from 1, or "all".
        split: Split that comes with the data, or a seeded one: random, block, or place. Without enough rows for a random
            split, 13, all other places predict each one.
        seed: Seed of everything random.
        also: Predictors that are compared only when named, e.g. "nerf2", and predictors of your own, which stay as they are.
        only: Predictors beside the model of this package and the mean, in place of all that suit the data.
        preset: "quick", or "paper" for published settings.
        reference: Group whose offset is 0. Defaults to the most frequent one.
        not_detected: Meaning of an empty cell; see `RssiConfig`.
        validation: Folds that choose all settings: "random", "block" or "session". Defaults to those like the test rows.
        fewer: Fractions of the training rows that the model and "knn" are fitted to, too, e.g. (0.25, 0.5). After a random
            split both then predict a region of the training rows by all others.
        repeats: Number of splits, with seeds from `seed` on. Maps and tables are those of the first one.
        above: Thresholds of the coverage [dBm], the first one that of maps. Defaults to -67 for Wi-Fi, else -75.
        below: Thresholds of another quantity than RSSI, where smaller is better, e.g. latency; in place of `above`.
        rooms: Rooms whose coverage is recorded; see `swiftwrf.data.rooms.read_rooms`.
        device: Device to compute on.
        keep: Results by the names of predictors, in a folder, and the model. A call with equal data, options, code and
            versions continues after them, others are refused.
        executor: Processes that compute steps side by side, e.g. a `ProcessPoolExecutor`.
        parallel: Function that maps the fit of the model over receivers, e.g. on other machines; see `RssiModel.fit`.
        progress: Show a progress bar on a terminal.

    Raises:
        InputError: Unknown receivers, split or predictors, no test row that a receiver detects, too few rows, fewer than 5
            places, or `keep` of another call.

    Example:
        >>> import swiftwrf
        >>> result = compare(swiftwrf.rssi_room(n=60), receivers=["6"], seed=1)
        >>> bool(result.summary().loc["swiftwrf", "median"] < result.summary().loc["mean", "median"])
        True
    """
    # all but what changes no step
    given = {name: value for name, value in locals().items() if name not in ("above", "below", "rooms")}
    if below and (above or data.is_power):
        raise InputError("below is for another quantity than RSSI, e.g. latency, in place of above; use above")
    chosen = data.as_measured().receivers(receivers)
    small = is_small(chosen, split)
    train, test = (chosen, chosen) if small else chosen.split(split, seed)
    if repeats > 1 and (small or split in chosen.named_splits):
        raise InputError(f"repeats need a split with a seed: random, block or place; {data.name} has one split")
    if not bool(test.detected.any()):
        raise InputError(f"split {split!r} of {data.name} has no test rows that detect these receivers")
    pool = data if small else pool_of(data, train, test, split, seed)
    if pool.groups is not None:
        offsets = estimate_offsets(pool, reference)
        train, pool = offsets.removed(train), offsets.removed(pool)
    kind = train.validation_for(split, test) if validation == "auto" else validation
    options: Values = {"validation": kind, "seed": seed, "new_places": split == PLACE, "not_detected": not_detected}
    if kind == "random" != split:  # test rows of a split that comes with the data may be of another day or device
        options["calibration"] = "block"
    names, left_out = compared(chosen, also, only)
    own = {predictor.name: predictor for predictor in also if isinstance(predictor, RssiPredictor)}
    if keep is not None:
        if own:
            raise InputError(
                "keep takes predictors by name; register those of your own as entry points, or leave it out"
            )
        keep.of(given | {"predictors": [RSSI_PREDICTORS[name] for name in names]})
    shown = {"split": LEAVE_ONE_OUT if small else split, "preset": preset, "seed": seed}
    begun = RssiComparison(train, test, {}, shown, left_out, above=tuple(above), below=tuple(below), rooms=rooms)
    in_process = progress and executor is None
    fits = RssiFits(train, pool, test, own, preset, options, small, begun.model, device, progress=in_process)

    def repeat(_: RssiFits, folder: Path, number: int) -> Values:
        once: Values = {"seed": seed + number, "repeats": 1, "fewer": (), "keep": None, "progress": False}
        again = compare(**given | once)
        return {name: {"median": found["median"], "mean": found["mean"]} for name, found in again.values.items()}

    memo = keep or Memo()
    # fits that are computed here: those whose receivers go to other machines, and predictors that may not reach a worker
    here = Steps(replace(fits, parallel=parallel, progress=progress), memo)
    there = Steps(fits, memo, executor, writes=parallel is None)  # the model alone writes a file
    long = there if parallel is None else here
    of = {name: here if name in own else long if name == begun.model else there for name in names}
    with refusing_executor(executor):
        for name, steps in of.items():
            is_long = name in (begun.model, "gp")
            steps.start(name, f"fitting and testing {name}", RssiFits.tested, name, first=is_long)
        studied = [name for name in (begun.model, "knn") if name in names]
        if fewer:
            long.start("fewer rows", "fitting fewer rows", RssiFits.studied, studied, fewer, split, first=True)
        others = [
            here.start(f"split {number + 1}", f"fitting and testing split {number + 1}", repeat, number)
            for number in range(1, repeats)
        ]
        if long is here:
            there.submit()
        values = {name: steps[name] for name, steps in of.items()}
        studies = long["fewer rows"] if fewer else {"rows": {}, "region": {}}
        splits = [values, *(here[name] for name in others)] if others else []
    predictors = dict(fits.predictors)
    if begun.model in names and begun.model not in predictors:
        model = load(memo.folder / MODEL)
        assert isinstance(model, RssiModel | PairModel)
        predictors[begun.model] = model
    by_rows = DataFrame.from_dict(studies["rows"], orient="index")
    if fewer:
        by_rows.loc[str(len(train))] = {name: values[name]["mean"] for name in studied}
    by_rows = by_rows.set_index(by_rows.index.astype(int)).rename_axis("n_train")
    errors = [
        {"method": name, "seed": seed + number, "median": found[name]["median"], "mean": found[name]["mean"]}
        for number, found in enumerate(splits)
        for name in found
    ]
    begun = replace(begun, by_rows=by_rows, region=studies["region"], repeats=DataFrame(errors))
    return replace(begun, values=values, predictors=predictors)
