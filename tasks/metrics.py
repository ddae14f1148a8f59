"""The keys of metrics.json, shared by the experiments that write it and the pages and tables that read it.

Numbers are degrees, dB and seconds; a number that does not exist is nan here and null in the file.
"""

from __future__ import annotations

from typing import Literal, TypedDict, get_args

Angle = Literal["azimuth_deg", "elevation_deg", "great_circle_deg"]
Score = Literal["psnr_db", "ssim", "l1"]
ANGLES: tuple[Angle, ...] = get_args(Angle)
SCORES: tuple[Score, ...] = get_args(Score)


class ErrorSummary(TypedDict):
    """Of `n` errors or scores; `low` and `high` are the 95 % interval of the median."""

    median: float
    p90: float
    mean: float
    low: float
    high: float
    n: int


class RunMetrics(TypedDict):
    """What every task says of a run."""

    task: str
    data: str
    split: str
    preset: str
    seed: int
    n_train: int
    n_test: int


class SynthesisSeconds(TypedDict):
    """Of one synthesizer, the mean of the repeats."""

    fit: float
    synthesize: float


class SynthesisMetrics(TypedDict):
    """How well one synthesizer draws the test spectra."""

    psnr_db: ErrorSummary
    ssim: ErrorSummary
    l1: ErrorSummary
    seconds: SynthesisSeconds


class ArmSeconds(TypedDict):
    """Of one estimator, the mean of the repeats."""

    train: float
    estimate: float


class ArmMetrics(TypedDict):
    """How wrong one estimator is."""

    azimuth_deg: ErrorSummary
    elevation_deg: ErrorSummary
    great_circle_deg: ErrorSummary
    seconds: ArmSeconds


class MixSeconds(TypedDict):
    """Of the synthesizers asked for and of all networks together."""

    fit: float
    synthesize: float
    train: float


class ChoiceMetrics(TypedDict):
    """Which synthesizer was taken: median PSNR [dB] on held-out measured spectra, and seconds, of each candidate."""

    name: str
    psnr_db: dict[str, float]
    seconds: dict[str, float]


class ChangeMetrics(TypedDict):
    """Median error with synthetic spectra, its relative change (-0.3 is 30 % lower), and the change's 95 % interval."""

    median_deg: float
    change: float
    low: float
    high: float


class GainMetrics(ChangeMetrics):
    """The same with so many further positions, drawn or predicted."""

    extra: int
    sampled: bool


class AdviceMetrics(TypedDict):
    """What turbo learning gains on measured spectra that were held out: further positions are recommended where each number
    of them gains, and it `helps` where the interval excludes no gain, too."""

    stand_in: str
    n_held_out: int
    measured_only_deg: float
    gains: list[GainMetrics]
    sampled: bool
    recommended_extra: int
    helps: bool


class MixMetrics(TypedDict):
    """One measured share; `choice` and `advice` of the first repeat, `counts` of spectra by origin in each training set."""

    n_measured: int
    counts: dict[str, dict[str, int]]
    choice: ChoiceMetrics | None
    advice: AdviceMetrics | None
    synthesis: dict[str, SynthesisMetrics]
    methods: dict[str, ArmMetrics]
    seconds: MixSeconds


class AoaMetrics(RunMetrics):
    """Of a run of tasks.aoa; `mixes` by measured share."""

    repeats: int
    moving: str
    extra: int
    grid: tuple[int, int]
    line_of_sight_share: float
    mixes: dict[str, MixMetrics]


class PredictorSeconds(TypedDict):
    """Of one predictor."""

    fit: float
    predict: float


class ReceiverMetrics(TypedDict):
    """How wrong a predictor is at one receiver."""

    abs_error_db: ErrorSummary


class PredictorMetrics(ReceiverMetrics):
    """How wrong a predictor is at all receivers, and how long it took."""

    seconds: PredictorSeconds


class IntervalMetrics(TypedDict):
    """Nominal and measured share of the test values inside SwiftWRF's interval."""

    nominal: float
    coverage: float


class ChosenMetrics(TypedDict):
    """What the fit of SwiftWRF chose."""

    n_primitives: int


class RssiMetrics(RunMetrics):
    """Of a run of tasks.rssi; `receivers` by receiver and method; `left_out` says why a method is not there."""

    overall: dict[str, PredictorMetrics]
    left_out: dict[str, str]
    receivers: dict[str, dict[str, ReceiverMetrics]]
    seconds: PredictorSeconds
    interval: IntervalMetrics
    chosen: ChosenMetrics
