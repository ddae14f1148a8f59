"""Keys of metrics.json, shared by the experiments that write it and the pages and tables that read it.

Units are degrees, dB and seconds. A number that does not exist is nan here and null in the file.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NotRequired, TypedDict

if TYPE_CHECKING:  # which import torch
    from augment.turbo.results import MixMetrics
    from swiftwrf.metrics import ErrorSummary


class RunMetrics(TypedDict):
    """Metrics of a run of every task."""

    task: str
    data: str
    split: str
    seed: int
    n_train: int
    n_test: int


class AoaMetrics(RunMetrics):
    """Metrics of a run of tasks.aoa; `mixes` by measured fraction, `notes` of the reader of the data."""

    preset: str
    repeats: int
    moving: str
    notes: list[str]
    extra: int
    grid: tuple[int, int]
    line_of_sight_share: float
    mixes: dict[str, MixMetrics]


class PredictorSeconds(TypedDict):
    """Seconds of one predictor."""

    fit: float
    predict: float


class ReceiverMetrics(TypedDict):
    """Errors of a predictor at one receiver."""

    abs_error_db: ErrorSummary


class PredictorMetrics(ReceiverMetrics):
    """Errors of a predictor at all receivers, its seconds, and the shares of detected and empty cells predicted as such."""

    seconds: PredictorSeconds
    detection: NotRequired[tuple[float, float] | None]


class IntervalMetrics(TypedDict):
    """Nominal and measured share of the test values inside SwiftWRF's interval."""

    nominal: float
    coverage: float


class ChosenMetrics(TypedDict):
    """Choices of the fit of SwiftWRF."""

    n_primitives: int
    floor_attenuation_db: NotRequired[float | None]


class RssiMetrics(RunMetrics):
    """Metrics of a run of tasks.rssi.

    `notes` are those of the reader. `receivers` is by receiver and method, `left_out` is the reason why a method is missing.
    `model` is the method whose maps and intervals the run contains. `by_rows` are mean errors [dB] by the number of training
    rows and by method.
    """

    notes: list[str]

    preset: str
    model: str
    overall: dict[str, PredictorMetrics]
    left_out: dict[str, str]
    receivers: dict[str, dict[str, ReceiverMetrics]]
    seconds: PredictorSeconds
    interval: IntervalMetrics
    by_rows: dict[str, dict[str, float]]
    chosen: ChosenMetrics


class LocalizerMetrics(TypedDict):
    """Position errors of one localizer, in space and in plan, its seconds, and with floors the fraction of right ones."""

    position_error_m: ErrorSummary
    horizontal_error_m: ErrorSummary
    seconds: PredictorSeconds
    floor_hit_rate: NotRequired[float]


class StudyMetrics(TypedDict):
    """Position errors of one localizer fitted to a part of the training rows or of the receivers."""

    localizer: str
    n_train: int
    n_receivers: int
    position_error_m: ErrorSummary


class LocateMetrics(RunMetrics):
    """Metrics of a run of tasks.locate.

    `n_undetected` test rows are left out, because no receiver detected them. `calibration` is the fraction of the test
    positions in the posterior's credible regions by their probability. `weights` are those of its likelihoods. `notes` are
    those of the reader.
    """

    notes: list[str]

    n_receivers: int
    n_undetected: int
    overall: dict[str, LocalizerMetrics]
    calibration: dict[str, float]
    weights: dict[str, float]
    by_rows: list[StudyMetrics]
    by_receivers: list[StudyMetrics]
