"""Results of turbo learning: errors of each condition and test spectrum, scores, histories, and their summaries."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from pandas import DataFrame
from torch import Tensor

from augment.cross_validation import (
    LOCATOR,
    STAND_IN,
    EstimatorChoiceMetrics,
    choose_estimator,
)
from augment.turbo.choice import CrossValidation, FoldLocating
from augment.turbo.condition import LOCATED, Condition, MeasuredSubset, Row, located_by, pooled, reference_of
from augment.turbo.experiment import ROOM_MODEL, Experiment
from augment.turbo.locating import LEVEL, NO_PLANE, Locating
from augment.turbo.synthesis import Evaluation, RoomSearch, Synthesis
from swiftwrf.choices import AUTO, fraction_key
from swiftwrf.metrics import ErrorSummary, angle_errors, paired_change, summary
from swiftwrf.models import FIELD_MODELS
from swiftwrf.runtime.steps import Step

ANGLES = ("azimuth_deg", "elevation_deg", "great_circle_deg")


class Results:
    """Results of the steps, collected one by one; `on_note` is called with each sentence about a method that is missing."""

    def __init__(self, experiment: Experiment, on_note: Callable[[str], object] | None = None) -> None:
        self.experiment, self.test = experiment, experiment.test
        self.evaluated: list[tuple[Condition, Row]] = []
        self.synthesis: list[Row] = []  # scores of each test spectrum
        self.synthesis_seconds: list[Row] = []
        self.history: list[Row] = []
        self.chosen: dict[str, Row] = {}  # by measured fraction, of the first repeat
        self.located_folds: dict[str, dict[int, list[float] | None]] = {}  # errors by fold, in the same way
        self.left_out: dict[Condition, str] = {}  # conditions, and why
        self.notes: list[str] = []  # a sentence for each method that is missing
        self._on_note = on_note
        fractions = [MeasuredSubset(fraction) for fraction in experiment.fractions]
        for name, reason in experiment.lacking.items():
            self.left_out |= {Condition(name, "measured", **subset.columns): reason for subset in fractions}
        for reason in dict.fromkeys(experiment.lacking.values()):
            names = ", ".join(name for name, own in experiment.lacking.items() if own == reason)
            self._note(f"left out: {names}, because {reason}")
        if missing := FIELD_MODELS[ROOM_MODEL].lacking(self.test):
            reason = f"it needs the {missing[0]}, which {self.test.name} does not describe"
            self._note(f"{LOCATOR} is left out: {reason}")
            self.left_out |= {located_by(subset): reason for subset in fractions}

    def add(self, step: Step[Experiment], value: Row) -> None:
        """Add the result of one step."""
        match step:
            case CrossValidation():
                self.chosen.setdefault(step.subset.key, value)
            case FoldLocating() if step.compared.subset.repeat == 0:
                self.located_folds.setdefault(step.compared.subset.key, {})[step.number] = value["errors"]
            case Synthesis() if "refused" in value:
                self._note(f"{step.synthesizer} is left out of the comparison: {value['refused']}")
            case Synthesis():
                self._add_synthesis(step, value)
            case RoomSearch() if not value.get("planes"):
                if step.locates:
                    self._leave_out_locating(step.subset, value.get("refused", NO_PLANE))
            case Locating() if "refused" in value:
                self._leave_out_locating(step.subset, value["refused"])
            case Evaluation() | Locating():
                self.evaluated.append((step.condition, value))
                self.history += [step.condition.columns | row for row in value["history"]]

    @property
    def pooled(self) -> list[tuple[Condition, Row]]:
        """Results by condition, such that each condition has all repeats."""
        return pooled(self.evaluated, self.experiment.models == (AUTO,))

    def errors(self) -> list[Row]:
        """Return one row for each condition and test spectrum: truth, estimate and errors."""
        rows: list[Row] = []
        for condition, value in self.pooled:
            estimate = torch.tensor(value["estimate"], dtype=torch.float64)
            columns = {
                "index": self.test.index,
                "line_of_sight": self.test.line_of_sight,
                "truth_azimuth_deg": self.test.label[:, 0].rad2deg(),
                "truth_elevation_deg": self.test.label[:, 1].rad2deg(),
                "estimate_azimuth_deg": estimate[:, 0].rad2deg(),
                "estimate_elevation_deg": estimate[:, 1].rad2deg(),
            }
            errors = angle_errors(estimate, self.test.label)
            columns |= {f"{angle}_deg": error.rad2deg() for angle, error in errors.items()}
            rows += rows_of(condition.columns, columns)
        return rows

    def positions(self) -> list[Row]:
        """Return one row for each condition that locates and each test spectrum: truth, estimate, error and radius."""
        rows: list[Row] = []
        for condition, value in self.evaluated:
            if "located" not in value:
                continue
            found = {name: torch.tensor(value["located"][name]) for name in ("radius", "level", "ambiguous")}
            estimate = torch.tensor(value["located"]["position"], dtype=torch.float64)
            error = (estimate - self.test.position).norm(dim=1)
            columns = {"index": self.test.index}
            for name, at in (("truth", self.test.position), ("estimate", estimate)):
                columns |= {f"{name}_{axis}_m": at[:, number] for number, axis in enumerate("xyz")}
            columns |= {
                "error_m": error,
                "credible_radius_80_m": found["radius"],
                "covered": found["level"] < LEVEL,
                "containing_level": found["level"],
                "ambiguous": found["ambiguous"],
            }
            rows += rows_of(condition.columns, columns)
        return rows

    def _leave_out_locating(self, subset: MeasuredSubset, reason: str) -> None:
        """Record why matched-field processing is not in the results of a subset."""
        self._note(f"{LOCATOR} is left out with {subset.measured_fraction:.0%} measured: {reason}")
        self.left_out[located_by(subset)] = reason

    def _note(self, sentence: str) -> None:
        if sentence not in self.notes:
            self.notes.append(sentence)
            if self._on_note is not None:
                self._on_note(sentence)

    def _add_synthesis(self, step: Synthesis, value: Row) -> None:
        key = step.subset.columns | {"synthesizer": step.synthesizer}
        columns = {score: torch.tensor(values) for score, values in value["scores"].items()}
        self.synthesis += rows_of(key, {"index": self.test.index} | columns)
        self.synthesis_seconds.append(key | value["seconds"] | {"trains": step.trains})
        self.history += [key | row for row in value["history"]]

    def summary(self, fraction: float) -> Row:
        """Return the numbers of metrics.json for one measured fraction.

        Returns:
            n_measured: Number of measured spectra.
            counts: Spectra by origin in each training set.
            choice: Chosen field model, trimmed mean PSNR [dB] and seconds of each candidate, and reasons why others could
                not be fitted. This and the next two are of the first repeat, None without a comparison.
            cross_validation: `CrossValidationMetrics` by field model.
            estimator_choice: `EstimatorChoiceMetrics`.
            synthesis: Quality of each field model at the test positions, and its mean seconds to `fit` and `synthesize`.
            methods: Condition, errors, mean seconds and `changes` of each method. These are changes of the angular error by
                synthetic spectra, by the method that it is compared to: the same estimator on measured spectra, and the
                reference. Their intervals are paired over test positions.
            reference: Method with the smallest test error on measured spectra, without matched-field processing.
            locating: Position error [m], fractions of test positions in their 80 % region and of ambiguous spectra,
                weights of the likelihoods (first repeat) and mean seconds of each method that locates.
            left_out: Reasons why methods are missing.
            seconds: Those to `fit` and `synthesize` of the trained field models, and to `train` all networks.
        """
        chosen = self.chosen.get(fraction_key(fraction), {})
        evaluated = [(c, value) for c, value in self.evaluated if c.measured_fraction == fraction]
        scores, fits = _of_fraction(self.synthesis, fraction), _of_fraction(self.synthesis_seconds, fraction)
        spent, trained = averaged(fits, "synthesizer", ("fit", "synthesize")), fits[fits["trains"]]
        methods, reference = self._method_metrics(fraction)
        return {
            "n_measured": round(fraction * len(self.experiment.train)),
            "counts": {condition.training_set: value["counts"] for condition, value in evaluated},
            "choice": chosen.get("choice"),
            "cross_validation": chosen.get("cross_validation"),
            "estimator_choice": self._estimator_choice(fraction),
            "synthesis": {
                name: {**entry, "seconds": spent[name]}
                for name, entry in summaries(scores, "synthesizer", ("psnr_db", "ssim", "l1")).items()
            },
            "methods": methods,
            "reference": reference,
            "locating": self._locating_metrics(fraction),
            "left_out": {c.method: reason for c, reason in self.left_out.items() if c.measured_fraction == fraction},
            "seconds": {
                "fit": float(trained["fit"].sum()),
                "synthesize": float(trained["draw"].sum()),
                "train": sum(value["seconds"]["train"] for condition, value in evaluated if condition.is_network),
            },
        }

    def _estimator_choice(self, fraction: float) -> EstimatorChoiceMetrics | None:
        """Return the choice of the estimator by cross-validation. None if field models could not be compared."""
        key = fraction_key(fraction)
        if (chosen := self.chosen.get(key, {})).get("choice") is None:
            return None
        errors = {
            self._pooled_name(name, fraction): [np.array(fold) for fold in folds]
            for name, folds in chosen["errors"].items()
        }
        located = self.located_folds.get(key, {})
        if not any(c.estimator == LOCATOR and c.measured_fraction == fraction for c, _ in self.pooled):
            located = {}  # its fit was refused
        choice = choose_estimator(
            errors,
            {n: None if own is None else np.array(own) for n, own in located.items()},
            LOCATED,
        )
        return {**choice, "better": self._better(fraction, choice)}

    def _better(self, fraction: float, choice: EstimatorChoiceMetrics) -> dict[str, str]:
        """Return the methods that are significantly better than the chosen one on the test spectra, and why not chosen."""
        errors = _of_fraction(self.errors(), fraction).groupby("method")
        error = {method: by_repeat(part, "great_circle_deg") for method, part in errors}
        reasons = {}
        for condition, _ in self.pooled:
            if condition.measured_fraction != fraction or condition.training == "all measured":
                continue
            if condition.method in choice["held_out_deg"]:
                reason = "its error on held-out measured spectra is larger"
            elif condition.is_network:
                reason = f"{STAND_IN} stands in for the network, whose training takes too long for cross-validation"
            elif condition.estimator == LOCATOR:
                reason = "no planes were found without the held-out spectra"
            else:
                reason = f"synthetic spectra are compared by {STAND_IN} and the first field model alone"
            reasons[condition.method] = reason
        better = [name for name in reasons if paired_change(error[choice["name"]], error[name])["high"] < 0]
        return {name: reasons[name] for name in sorted(better, key=lambda name: float(np.median(error[name])))}

    def _pooled_name(self, method: str, fraction: float) -> str:
        """Return the name under which `pooled` has a method of the stand-in in the first repeat."""
        own = [condition for condition, _ in self.pooled if condition.measured_fraction == fraction]
        if any(condition.method == method for condition in own):
            return method
        return next((c.method for c in own if c.is_turbo and c.estimator == STAND_IN), method)

    def _method_metrics(self, fraction: float) -> tuple[dict[str, Row], str]:
        """Return the metrics of each method, and the reference of changes."""
        own = [(condition, value) for condition, value in self.pooled if condition.measured_fraction == fraction]
        conditions = {condition.method: condition for condition, _ in reversed(own)}  # of the first repeat
        errors = _of_fraction(self.errors(), fraction)
        times = DataFrame([c.columns | value["seconds"] for c, value in own])
        seconds = averaged(times, "method", ("train", "estimate"))
        found = summaries(errors, "method", ANGLES)
        reference = reference_of(
            conditions, {name: entry["great_circle_deg"]["median"] for name, entry in found.items()}
        )
        error = {method: by_repeat(part, "great_circle_deg") for method, part in errors.groupby("method")}
        metrics = {}
        for method, entry in found.items():
            condition = conditions[method]
            others = dict.fromkeys((condition.measured_only.method, reference)) if condition.is_turbo else ()
            changes = {other: paired_change(error[other], error[method]) for other in others if other in conditions}
            metrics[method] = {**condition.description, **entry, "changes": changes, "seconds": seconds[method]}
        return metrics, reference

    def _locating_metrics(self, fraction: float) -> dict[str, Row]:
        rows = _of_fraction(self.positions(), fraction)
        if not len(rows):
            return {}
        own = [(c, v["located"]) for c, v in self.evaluated if "located" in v and c.measured_fraction == fraction]
        weights = {c.method: found["weights"] for c, found in reversed(own)}  # of the first repeat
        times = DataFrame([c.columns | found["seconds"] for c, found in own])
        seconds = averaged(times, "method", ("room", "fit", "locate"))
        shares = averaged(rows, "method", ("covered", "ambiguous"))
        return {
            method: {
                "position_error_m": entry["error_m"],
                "coverage_80": shares[method]["covered"],
                "ambiguous": shares[method]["ambiguous"],
                "weights": weights[method],
                "seconds": seconds[method],
            }
            for method, entry in summaries(rows, "method", ("error_m",)).items()
        }


def _of_fraction(rows: list[Row], fraction: float) -> DataFrame:
    """Return the rows of a measured fraction as a table."""
    return DataFrame([row for row in rows if row["measured_fraction"] == fraction])


def rows_of(key: Row, columns: dict[str, Tensor]) -> list[Row]:
    """Return the rows of a table of columns, each with the same key."""
    lists = {name: column.tolist() for name, column in columns.items()}
    return [key | dict(zip(lists, values, strict=True)) for values in zip(*lists.values(), strict=True)]


def summaries(table: DataFrame, by: str, columns: Sequence[str]) -> dict[str, dict[str, ErrorSummary]]:
    """Return a summary of columns of errors over all test rows (`index`) and repeats, for each value of `by`."""
    return {
        str(name): {column: repeated_summary(by_repeat(part, column)) for column in columns}
        for name, part in table.groupby(by, sort=False)
    }


def by_repeat(table: DataFrame, column: str) -> NDArray[np.float64]:
    """Return a column with a row for each test row and a column for each repeat, (n, repeats)."""
    values: NDArray[np.float64] = table.pivot(index="index", columns="repeat", values=column).to_numpy(np.float64)
    return values


def repeated_summary(values: NDArray[np.float64]) -> ErrorSummary:
    """Return the summary of all values (n, repeats), with the number of test rows.

    Repeats of a test row are not independent, so they do not narrow the interval of the median as independent values would
    (quantiles in cluster samples: R. S. Woodruff, JASA 47, 1952).

    Example:
        >>> once = np.arange(100.0)[:, None]
        >>> found = repeated_summary(np.repeat(once, 3, axis=1))
        >>> found["median"], found["n"], (found["low"], found["high"])
        (49.5, 100, (40.0, 59.0))
    """
    found = summary(values.ravel())
    rows = values[np.isfinite(values).any(axis=1)]
    if values.shape[1] > 1 and len(rows):
        below = np.nanmean(np.where(np.isnan(rows), np.nan, rows <= found["median"]), axis=1)
        margin = 1.96 * below.std() / math.sqrt(len(rows))
        low, high = np.nanquantile(rows, (max(0.0, 0.5 - margin), min(1.0, 0.5 + margin))).tolist()
        found = {**found, "low": low, "high": high}
    return {**found, "n": len(rows)}


def averaged(table: DataFrame, by: str, columns: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the mean of each column for each value of `by`."""
    means: dict[str, dict[str, float]] = table.groupby(by, sort=False)[list(columns)].mean().to_dict("index")
    return means
