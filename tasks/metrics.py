"""Keys of metrics.json, shared by the experiments that write it and the pages and tables that read it.

Units are degrees, dB and seconds. A number that does not exist is nan here and null in the file.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NotRequired, TypedDict, get_args

if TYPE_CHECKING:  # which import torch
    from augment.cross_validation import CrossValidationMetrics, EstimatorChoiceMetrics
    from swiftwrf.metrics import ChangeMetrics, ErrorSummary

Angle = Literal["azimuth_deg", "elevation_deg", "great_circle_deg"]
Score = Literal["psnr_db", "ssim", "l1"]
ANGLES: tuple[Angle, ...] = get_args(Angle)
SCORES: tuple[Score, ...] = get_args(Score)


class RunMetrics(TypedDict):
    """Metrics of a run of every task."""

    task: str
    data: str
    split: str
    seed: int
    n_train: int
    n_test: int


class SynthesisMetrics(TypedDict):
    """Quality of one field model at the test positions; seconds to `fit` and to `synthesize`, means of the repeats."""

    psnr_db: ErrorSummary
    ssim: ErrorSummary
    l1: ErrorSummary
    seconds: dict[str, float]


class MethodMetrics(TypedDict):
    """Errors of one condition; seconds to `train` and to `estimate`, means of the repeats.

    `changes`, of conditions with synthetic spectra, is the change of the angular error by the method that it is compared to:
    the same estimator on measured spectra, and the best one on measured spectra. Its interval is paired over test positions.
    """

    estimator: str
    training: str
    synthesizer: str
    n_synthetic: int
    azimuth_deg: ErrorSummary
    elevation_deg: ErrorSummary
    great_circle_deg: ErrorSummary
    changes: dict[str, ChangeMetrics]
    seconds: dict[str, float]


class ChoiceMetrics(TypedDict):
    """Chosen field model; trimmed mean PSNR [dB] and seconds of each candidate; reasons why others could not be fitted."""

    name: str
    psnr_db: dict[str, float]
    seconds: dict[str, float]
    left_out: dict[str, str]


class LocatingMetrics(TypedDict):
    """Metrics of located test positions.

    Position error [m], fraction of the test positions inside their 80 % credible region, fraction of ambiguous spectra, and
    weights of the likelihoods (first repeat). Seconds, means of the repeats, are those to find the `room`, to `fit` the
    locator and to `locate` all test spectra.
    """

    position_error_m: ErrorSummary
    coverage_80: float
    ambiguous: float
    weights: list[float]
    seconds: dict[str, float]


class MixMetrics(TypedDict):
    """Metrics of one measured fraction.

    `choice`, `cross_validation` (by field model) and `estimator_choice` are of the first repeat. `counts` are spectra by
    origin in each training set. Seconds are those to `fit` and `synthesize` of the trained field models and to `train` all
    networks.

    The method on measured spectra with the smallest test error, without matched-field processing, is the `reference`. Values
    of `locating` are by method. Values of `left_out` are reasons why a method is missing.
    """

    n_measured: int
    counts: dict[str, dict[str, int]]
    choice: ChoiceMetrics | None
    cross_validation: dict[str, CrossValidationMetrics] | None
    estimator_choice: EstimatorChoiceMetrics | None
    synthesis: dict[str, SynthesisMetrics]
    methods: dict[str, MethodMetrics]
    reference: str
    locating: dict[str, LocatingMetrics]
    left_out: dict[str, str]
    seconds: dict[str, float]


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
    """Errors of a predictor at all receivers, and its seconds."""

    seconds: PredictorSeconds


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
    `model` is the method whose maps and intervals the run contains.
    """

    notes: list[str]

    preset: str
    model: str
    overall: dict[str, PredictorMetrics]
    left_out: dict[str, str]
    receivers: dict[str, dict[str, ReceiverMetrics]]
    seconds: PredictorSeconds
    interval: IntervalMetrics
    chosen: ChosenMetrics


class LocalizerMetrics(TypedDict):
    """Position errors of one localizer, in space and in plan, and its seconds."""

    position_error_m: ErrorSummary
    horizontal_error_m: ErrorSummary
    seconds: PredictorSeconds


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
