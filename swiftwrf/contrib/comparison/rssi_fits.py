"""Fits of RSSI predictors to the training rows of one split, as steps of a comparison."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from swiftwrf.contrib.comparison.base import Values
from swiftwrf.contrib.comparison.leave_one_out import predict_each_place
from swiftwrf.contrib.comparison.parts import fewer_rows, region_of
from swiftwrf.contrib.comparison.predictors import make_predictor
from swiftwrf.contrib.comparison.steps import MODEL
from swiftwrf.data import Rssi
from swiftwrf.rssi.base import Map, RssiPredictor
from swiftwrf.runtime.checkpoint import Saved
from swiftwrf.runtime.validation import Preset


@dataclass(frozen=True, eq=False)
class RssiFits:
    """Rows of a split, and the options of the predictors that are fitted to them.

    Args:
        train: Training rows, without offsets between groups.
        pool: The same rows at all receivers.
        test: Test rows.
        own: Predictors of the user by name.
        preset: Sizes of the predictors.
        options: Options of the predictors.
        is_small: Each place is predicted by all others, because there are too few rows for a split.
        model: Name of the predictor that is saved.
        device: Device to compute on.
        parallel: Function that maps a fit over receivers; see `RssiPredictor.fit`.
        progress: Show a progress bar on a terminal.
        predictors: Fitted predictors by name, which `tested` adds.
    """

    train: Rssi
    pool: Rssi
    test: Rssi
    own: Mapping[str, RssiPredictor]
    preset: Preset
    options: Values
    is_small: bool
    model: str
    device: torch.device | str
    parallel: Map | None = None
    progress: bool = False
    predictors: dict[str, RssiPredictor] = field(default_factory=dict)

    def fitted(self, name: str, train: Rssi, pool: Rssi, **options: str) -> RssiPredictor:
        """Return a predictor that is fitted to rows, which `pool` has at all receivers."""
        own = deepcopy(self.own[name]) if name in self.own else None
        predictor = own or make_predictor(name, self.preset, **self.options | options)
        return predictor.fit(train, pool=pool, device=self.device, parallel=self.parallel, progress=self.progress)

    def tested(self, folder: Path, name: str) -> Values:
        """Fit a predictor to the training rows and return what it predicts at the test rows. Save it if it is the model."""
        test, detected, probability = self.test, self.test.detected, None
        began = time.perf_counter()
        predictor = self.predictors[name] = self.fitted(name, self.train, self.pool)
        fitted = time.perf_counter()
        if self.is_small:
            prediction, probability = predict_each_place(partial(self.fitted, name), self.train, self.pool)
        else:
            prediction = predictor.predict_detected(test)
        seconds = {"fit": fitted - began, "predict": time.perf_counter() - fitted}
        if name == self.model and isinstance(predictor, Saved):
            predictor.save(folder / MODEL)
        # fractions of detected and of empty test cells that are predicted as such, if there are both kinds
        detection = None
        if predictor.detection is not None and not bool(detected.all()) and not test.receiver_moves:
            if probability is None:
                probability = predictor.predict_detection(test.transmitter_position, self._offset)
            above = probability > 0.5
            detection = float(above[detected].double().mean()), float((~above)[~detected].double().mean())
        error = _errors(prediction.mean + self._offset, test)
        return {
            "seconds": seconds,
            "predicted": prediction.mean[detected],
            "std": None if prediction.std is None else prediction.std[detected],
            "mean": float(error.mean()),
            "median": float(error.quantile(0.5)),
            "held_out": getattr(predictor, "held_out_db", {}),
            "detection": detection,
            "n_primitives": getattr(predictor, "n_primitives", 0),
        }

    def studied(self, folder: Path, names: Sequence[str], fractions: Sequence[float], split: str) -> Values:
        """Return the mean absolute errors of predictors that are fitted to fewer rows.

        Args:
            folder: Folder of the comparison.
            names: Predictors.
            fractions: Fractions of the training rows, whose fits predict the test rows.
            split: Split of the comparison. In a random one, a region of the training rows is predicted by all others, too.
        """
        train, seed = self.train, self.options["seed"]
        region = region_of(train, seed) if split == "random" else None

        def error_at(rows: Tensor, name: str) -> float:
            predictor = self.fitted(name, train.subset(rows), self.pool.subset(rows))
            return float(_errors(predictor.predict_detected(self.test).mean + self._offset, self.test).mean())

        def error_in(out: Tensor, others: Tensor, name: str) -> float:
            asked, rest = train.subset(out), (train.subset(others), self.pool.subset(others))
            predictor = self.fitted(name, *rest, validation="block")
            return float(_errors(predictor.predict_detected(asked).mean, asked).mean())

        parts = fewer_rows(train, fractions, seed)
        return {
            "rows": {str(len(rows)): {name: error_at(rows, name) for name in names} for rows in parts},
            "region": {} if region is None else {name: error_in(*region, name) for name in names},
        }

    @property
    def _offset(self) -> Tensor | float:
        """Offset of the group of each test row (n, 1), if rows have groups."""
        return 0.0 if self.train.offsets is None else self.train.offsets.of(self.test)[:, None]


def _errors(predicted: Tensor, rows: Rssi) -> Tensor:
    """Return the absolute errors at the detected pairs of rows (n,)."""
    return (predicted - rows.rssi_dbm)[rows.detected].abs()
