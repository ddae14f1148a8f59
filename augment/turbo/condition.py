"""Conditions of turbo learning: which estimator is trained on which spectra. They are the key of every result."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, TypeVar

from augment.choices import AUTO, fraction_key
from augment.cross_validation import LOCATOR, STAND_IN
from augment.estimators import ESTIMATORS
from swiftwrf.runtime.validation import Preset

Row = dict[str, Any]
Training = Literal["measured", "measured + synthetic", "measured + synthetic + extra", "all measured"]
NETWORK = "network"  # name of a run's network in its results
NETWORKS: dict[Preset, str] = {"quick": "aann_kernel", "paper": "aann"}  # which one it is
MEASURED_NETWORK, FULL_NETWORK = f"{NETWORK}, measured", f"{NETWORK}, all measured"  # lower and upper reference
LOCATED = f"{LOCATOR}, measured"
CHOSEN = "chosen"  # file of the chosen estimator if it is not among those that every run keeps
Value = TypeVar("Value")


@dataclass(frozen=True)
class MeasuredSubset:
    """A random fraction (0, 1] of the training spectra that counts as measured. Each repeat has its own seed."""

    measured_fraction: float
    repeat: int = 0
    without: tuple[int, ...] = ()  # folds that are held out

    def __str__(self) -> str:
        return "_".join((f"mix{self.key}-r{self.repeat}", *map(str, self.without)))

    @property
    def key(self) -> str:
        """Measured fraction in metrics.json and in file names."""
        return fraction_key(self.measured_fraction)


@dataclass(frozen=True)
class Condition:
    """One estimator on one training set.

    Example:
        >>> Condition("kernel_regression", "measured + synthetic", "hybrid").method
        'kernel_regression, measured + synthetic (hybrid)'
    """

    estimator: str
    training: Training  # measured spectra, synthetic ones at the withheld and at extra positions, or all as measured
    synthesizer: str = ""  # field model of the synthetic spectra, empty without any
    n_synthetic: int = 0  # number of extra synthetic positions
    measured_fraction: float = 1.0
    repeat: int = 0

    @property
    def name(self) -> str:
        """Name of the estimator. A run has one network, whose name does not depend on the preset."""
        return NETWORK if self.is_network else self.estimator

    @property
    def training_set(self) -> str:
        """Name of the training set, with the field model of its synthetic spectra."""
        return f"{self.training} ({self.synthesizer})" if self.synthesizer else self.training

    @property
    def method(self) -> str:
        """Name of the condition in all results: estimator and training set, of which untrained estimators have none."""
        trained = self.estimator not in ESTIMATORS or ESTIMATORS[self.estimator].trainable
        return f"{self.name}, {self.training_set}" if trained else self.name

    @property
    def subset(self) -> MeasuredSubset:
        """Measured spectra of the condition."""
        return MeasuredSubset(self.measured_fraction, self.repeat)

    @property
    def result_name(self) -> str:
        """Name of the kept result. Measured fractions share the result of a condition that is trained on all spectra."""
        part = f"r{self.repeat}" if self.training == "all measured" else self.subset
        return f"{re.sub(r'[^0-9A-Za-z_]+', '_', self.method).strip('_')}-{part}"

    @property
    def measured_only(self) -> Condition:
        """Condition of this estimator on the measured spectra alone."""
        return replace(self, training="measured", synthesizer="", n_synthetic=0)

    @property
    def is_turbo(self) -> bool:
        """True if the training set contains synthetic spectra."""
        return bool(self.synthesizer)

    @property
    def is_network(self) -> bool:
        """True if the estimator is a network. A run has one network."""
        return self.estimator in NETWORKS.values()

    @property
    def columns(self) -> Row:
        """Columns of the result tables."""
        return asdict(self) | {"method": self.method}

    @property
    def description(self) -> Row:
        """Columns that do not depend on measured fraction and repeat, for metrics.json."""
        return {name: getattr(self, name) for name in DESCRIPTION}


DESCRIPTION = ("estimator", "training", "synthesizer", "n_synthetic")


def conditions_of(methods: Mapping[str, Mapping[str, Any]]) -> dict[str, Condition]:
    """Return the condition of each method of metrics.json."""
    return {method: Condition(**{name: entry[name] for name in DESCRIPTION}) for method, entry in methods.items()}


def headline(conditions: Iterable[Condition]) -> Condition:
    """Return the condition that stands for turbo learning: the network with all spectra of the first field model.

    Without a network it is that of kernel regression. Errors on test spectra are not considered: the best of several would
    be too optimistic.

    Raises:
        ValueError: Neither was trained with synthetic spectra.
    """
    turbo = [c for c in conditions if c.is_turbo and (c.is_network or c.estimator == STAND_IN)]
    return max(turbo, key=lambda c: (c.is_network, c.training == "measured + synthetic + extra"))


def reference_of(conditions: Mapping[str, Condition], error: Mapping[str, float]) -> str:
    """Return the method with the smallest error among the estimators that are trained on measured spectra alone.

    A gain by synthetic spectra is relative to it. It is chosen by its error on test spectra. That favours the reference, so
    the gain by synthetic spectra is never overstated. Matched-field processing is left out, because it is no regression from
    spectra to directions.

    Example:
        >>> conditions = {c.method: c for c in (Condition("peak", "measured"), Condition("kernel_regression", "measured"))}
        >>> reference_of(conditions, {"peak": 9.0, "kernel_regression, measured": 2.0})
        'kernel_regression, measured'
    """
    alone = [name for name, c in conditions.items() if c.training == "measured" and c.estimator != LOCATOR]
    return min(alone, key=lambda name: error[name])


def pooled(results: list[tuple[Condition, Value]], auto: bool) -> list[tuple[Condition, Value]]:
    """Return results such that every condition with synthetic spectra has all repeats.

    A repeat stands for a user, who chooses a field model and the number of extra positions by cross-validation. The network
    is trained with extra positions or without them, other estimators both ways. The result that stands for a repeat is the
    one with extra positions, or the only one.

    | repeats | result with synthetic spectra | becomes |
    |---|---|---|
    | chose alike | each | the same condition |
    | chose differently, `auto` | that stands for its repeat | "measured + synthetic (auto)" |
    | chose differently, else | without extra positions, in all repeats | the same condition |
    | chose differently, else | that stands for its repeat, if one has extra positions | the condition with extra positions |
    """
    trainings: dict[str, dict[int, set[tuple[str, str]]]] = {}
    for condition, _ in results:
        if condition.is_turbo:
            repeats = trainings.setdefault(condition.estimator, {})
            repeats.setdefault(condition.repeat, set()).add((condition.synthesizer, condition.training))
    complete: list[tuple[Condition, Value]] = []
    for condition, value in results:
        repeats = trainings.get(condition.estimator, {})
        if not condition.is_turbo or len({frozenset(names) for names in repeats.values()}) == 1:
            complete.append((condition, value))
            continue
        most: Training = "measured + synthetic + extra"
        extra, own_way = (condition.synthesizer, most), (condition.synthesizer, condition.training)
        stands_for_repeat = own_way == extra or extra not in repeats[condition.repeat]
        if auto and stands_for_repeat:
            complete.append((replace(condition, training="measured + synthetic", synthesizer=AUTO), value))
        if not auto and own_way != extra and all(own_way in others for others in repeats.values()):
            complete.append((condition, value))
        if not auto and stands_for_repeat and any(extra in others for others in repeats.values()):
            complete.append((replace(condition, training=most), value))
    return complete
