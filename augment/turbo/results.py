"""Result of turbo learning: errors of each condition and test spectrum, scores, histories, and their summaries."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pandas import DataFrame, concat

from augment.cross_validation import LOCATOR, STAND_IN, choose_estimator
from augment.estimators import Estimator
from augment.turbo.condition import (
    LOCATED,
    Condition,
    MeasuredSubset,
    Row,
    chosen_file,
    conditions_of,
    pooled,
    reference_of,
)
from augment.turbo.experiment import ROOM_MODEL, Experiment
from augment.turbo.stages import training_set
from swiftwrf import load
from swiftwrf.choices import fraction_key
from swiftwrf.locate import MatchedField
from swiftwrf.metrics import LEVEL, ErrorSummary, angle_errors, paired_change, summary
from swiftwrf.models import FIELD_MODELS
from swiftwrf.runtime.registry import write_report

ANGLES = ("azimuth_deg", "elevation_deg", "great_circle_deg")


class TurboResult:
    """Errors of estimators trained on measured, synthetic and all spectra, and the one that cross-validation chose.

    Attributes:
        errors: A row for each condition and test spectrum: estimator, training set, truth, estimate and errors [deg].
        positions: A row for each condition that locates and test spectrum: truth, estimate and error [m].
        synthesis: A row for each field model and test spectrum: PSNR [dB], SSIM and L1 of the synthetic spectrum.
        history: Losses of the trainings, in rows.
        metrics: All summaries, as in metrics.json of a run: errors with intervals, paired changes, quality of the synthetic
            spectra, choices, times.
        best: The estimator that cross-validation on the measured spectra chose, trained. None if nothing was compared.
        left_out: A sentence for each method that is missing.

    Example:
        >>> import augment, swiftwrf
        >>> data = swiftwrf.simulated_room(n=40, grid=swiftwrf.AngularGrid.hemisphere(10, 40))
        >>> result = augment.turbo_learning(data, measured=0.5, models=["nearest"], estimators=["peak"], extra=0)
        >>> result.choice["name"], type(result.best).__name__
        ('kernel_regression, measured', 'KernelRegression')
    """

    def __init__(self, experiment: Experiment, fraction: float, folder: Path) -> None:
        self.experiment, self.fraction, self.folder = experiment, fraction, folder
        self.compared: Row = {}  # comparison of the field models in the first repeat
        self.synthesized: list[tuple[Row, Row]] = []  # columns and values of each field model
        self.evaluated: list[tuple[Condition, Row]] = []
        self.history: list[Row] = []
        self.missing: dict[str, str] = {}  # reason for each method that is missing
        self.left_out: list[str] = []
        for name, reason in experiment.lacking.items():
            names = ", ".join(name for name, own in experiment.lacking.items() if own == reason)
            self.leave_out(Condition(name, "measured").method, f"left out: {names}, because {reason}", reason)
        if missing := FIELD_MODELS[ROOM_MODEL].lacking(experiment.test):
            reason = f"it needs the {missing[0]}, which {experiment.test.name} does not describe"
            self.leave_out(LOCATED, f"{LOCATOR} is left out: {reason}", reason)

    def leave_out(self, method: str, sentence: str, reason: str) -> None:
        """Record why a method is missing, and a sentence about it."""
        self.missing[method] = reason
        self._note(sentence)

    def _note(self, sentence: str) -> None:
        if sentence not in self.left_out:
            self.left_out.append(sentence)

    def add_synthesis(self, subset: MeasuredSubset, name: str, trains: bool, value: Row) -> None:
        """Add the spectra of a field model at the test positions."""
        if "refused" in value:
            self._note(f"{name} is left out of the comparison: {value['refused']}")
            return
        key = asdict(subset) | {"synthesizer": name}
        self.synthesized.append((key, value | {"trains": trains}))
        self.history += [key | row for row in value["history"]]

    def add(self, condition: Condition, value: Row) -> None:
        """Add the estimates of a condition, or the reason why there are none."""
        if "refused" in value:
            reason, fraction = value["refused"], condition.measured_fraction
            self.leave_out(
                condition.method, f"{condition.name} is left out with {fraction:.0%} measured: {reason}", reason
            )
            return
        self.evaluated.append((condition, value))
        self.history += [condition.columns | row for row in value["history"]]

    @cached_property
    def pooled(self) -> list[tuple[Condition, Row]]:
        """Results by condition, such that each condition has all repeats."""
        return pooled(self.evaluated, auto=not self.experiment.named)

    @cached_property
    def errors(self) -> DataFrame:
        """A row for each condition and test spectrum: truth, estimate and errors."""
        test, tables = self.experiment.test, []
        truth = test.label.rad2deg()
        for condition, value in self.pooled:
            estimate = torch.tensor(value["estimate"], dtype=torch.float64)
            errors = angle_errors(estimate, test.label)
            columns = {
                "index": test.index,
                "line_of_sight": test.line_of_sight,
                "truth_azimuth_deg": truth[:, 0],
                "truth_elevation_deg": truth[:, 1],
                "estimate_azimuth_deg": estimate[:, 0].rad2deg(),
                "estimate_elevation_deg": estimate[:, 1].rad2deg(),
                **{f"{angle}_deg": error.rad2deg() for angle, error in errors.items()},
            }
            tables.append(DataFrame(condition.columns | columns))
        return concat(tables, ignore_index=True)

    @cached_property
    def positions(self) -> DataFrame:
        """A row for each condition that locates and each test spectrum: truth, estimate, error and radius."""
        test, tables = self.experiment.test, [DataFrame()]
        for condition, value in self.evaluated:
            if (found := value.get("located")) is None:
                continue
            estimate = torch.tensor(found["position"], dtype=torch.float64)
            columns: Row = {"index": test.index}
            for name, at in (("truth", test.position), ("estimate", estimate)):
                columns |= {f"{name}_{axis}_m": at[:, number] for number, axis in enumerate("xyz")}
            columns |= {
                "error_m": (estimate - test.position).norm(dim=1),
                "credible_radius_80_m": found["radius"],
                "covered": np.array(found["level"]) < LEVEL,
                "containing_level": found["level"],
                "ambiguous": found["ambiguous"],
            }
            tables.append(DataFrame(condition.columns | columns))
        return concat(tables, ignore_index=True)

    @cached_property
    def synthesis(self) -> DataFrame:
        """A row for each field model and test spectrum: PSNR [dB], SSIM and L1."""
        index = {"index": self.experiment.test.index}
        return concat([DataFrame(key | index | value["scores"]) for key, value in self.synthesized], ignore_index=True)

    @cached_property
    def metrics(self) -> Row:
        """Numbers of metrics.json for the measured fraction.

        Returns:
            n_measured: Number of measured spectra.
            counts: Spectra by origin in each training set.
            choice: Chosen field model, trimmed mean PSNR [dB] and seconds of each candidate, and reasons why others could
                not be fitted. This and the next two are of the first repeat, None without a comparison.
            cross_validation: Change of the error by extra synthetic spectra, by field model; see `cross_validate`.
            estimator_choice: Name of the method with the smallest median angular error on held-out measured spectra, that
                error of each candidate, and `better`: the methods with a significantly smaller error on the test spectra,
                best first, and why they are not chosen.
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
        scored = summaries(self.synthesis, "synthesizer", ("psnr_db", "ssim", "l1"))
        fits = DataFrame([key | value["seconds"] | {"trains": value["trains"]} for key, value in self.synthesized])
        spent, trained = averaged(fits, "synthesizer", ("fit", "synthesize")), fits[fits["trains"]]
        methods, reference = self._method_metrics()
        return {
            "n_measured": round(self.fraction * len(self.experiment.train)),
            "counts": {condition.training_set: value["counts"] for condition, value in self.evaluated},
            "choice": self.compared.get("choice"),
            "cross_validation": self.compared.get("cross_validation"),
            "estimator_choice": self._estimator_choice(),
            "synthesis": {name: {**entry, "seconds": spent[name]} for name, entry in scored.items()},
            "methods": methods,
            "reference": reference,
            "locating": self._locating_metrics(),
            "left_out": self.missing,
            "seconds": {
                "fit": float(trained["fit"].sum()),
                "synthesize": float(trained["draw"].sum()),
                "train": sum(value["seconds"]["train"] for c, value in self.evaluated if c.is_network),
            },
        }

    @property
    def choice(self) -> Row | None:
        """Choice of the estimator by cross-validation; `choice["name"]` is its method. None if nothing was compared."""
        found: Row | None = self.metrics["estimator_choice"]
        return found

    @cached_property
    def best(self) -> Estimator | MatchedField | None:
        """The estimator that cross-validation chose, as the first repeat trained it. None if nothing was compared."""
        if self.choice is None:
            return None
        chosen, experiment = conditions_of(self.metrics["methods"])[self.choice["name"]], self.experiment
        if file := chosen_file(self.folder, fraction_key(self.fraction), chosen):
            found = load(file)
            assert isinstance(found, Estimator | MatchedField)
            return found
        own = next((one for one, _ in self.evaluated if one.repeat == 0 and one.method == chosen.method), None)
        if own is None:
            return None
        estimator = experiment.make_estimator(own.estimator, 0)
        return estimator.fit(training_set(experiment, self.folder, own), device=experiment.device)

    def summary(self) -> DataFrame:
        """Return a row for each method, the smallest median first.

        `median`, `p90`, and `low` and `high` of the median's 95 % interval are those of the angle between true and estimated
        direction [deg]. `change` [%] is that of the median by synthetic spectra, relative to the same estimator on the
        measured spectra alone. Its interval, `change_low` and `change_high`, is paired over the test spectra.
        """
        conditions = conditions_of(self.metrics["methods"])
        rows: list[Row] = []
        for method, found in self.metrics["methods"].items():
            error = found["great_circle_deg"]
            change = found["changes"].get(conditions[method].measured_only.method)
            row: Row = {name: error[name] for name in ("median", "low", "high", "p90")}
            if change is not None:
                columns = {"change": "change", "change_low": "low", "change_high": "high"}
                row |= {column: 100 * change[name] for column, name in columns.items()}
            rows.append(row)
        return DataFrame(rows, index=list(self.metrics["methods"])).sort_values("median")

    def report(self, file: str | Path) -> None:
        """Write the report of `swiftwrf aoa` on this result into an HTML file, which opens offline.

        Raises:
            InputError: The file exists already.
        """
        write_report("aoa", self, file)

    def __repr__(self) -> str:
        error = self.summary()["median"]
        chosen = f", chosen: {self.choice['name']}" if self.choice else ""
        return f"<TurboResult: {len(error)} methods, best {error.index[0]} at {error.iloc[0]:.2f} degrees{chosen}>"

    @cached_property
    def _error(self) -> dict[str, NDArray[np.float64]]:
        """Angular errors [deg] of each method, (n, repeats)."""
        return {method: by_repeat(part, "great_circle_deg") for method, part in self.errors.groupby("method")}

    def _estimator_choice(self) -> Row | None:
        """Return the choice of the estimator by cross-validation. None if field models could not be compared."""
        if self.compared.get("choice") is None:
            return None
        methods = [condition for condition, _ in self.pooled]
        # where repeats chose differently, the stand-in with synthetic spectra has another name than in the first repeat
        other = next((c.method for c in methods if c.is_turbo and c.estimator == STAND_IN), None)
        own = {condition.method for condition in methods}
        errors = {
            name if name in own else other or name: [np.array(fold) for fold in folds]
            for name, folds in self.compared["errors"].items()
        }
        located = self.compared["located"] if LOCATED in own else {}  # otherwise its fit was refused
        found = {int(number): None if fold is None else np.array(fold) for number, fold in located.items()}
        choice = choose_estimator(errors, found, LOCATED)
        return {**choice, "better": self._better(choice)}

    def _better(self, choice: Row) -> dict[str, str]:
        """Return the methods that are significantly better than the chosen one on the test spectra, and why not chosen."""
        error, reasons = self._error, {}
        for condition, _ in self.pooled:
            if condition.training == "all measured":
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

    def _method_metrics(self) -> tuple[dict[str, Row], str]:
        """Return the metrics of each method, and the reference of changes."""
        conditions = {condition.method: condition for condition, _ in reversed(self.pooled)}  # of the first repeat
        times = DataFrame([c.columns | value["seconds"] for c, value in self.pooled])
        seconds = averaged(times, "method", ("train", "estimate"))
        found = summaries(self.errors, "method", ANGLES)
        reference = reference_of(
            conditions, {name: entry["great_circle_deg"]["median"] for name, entry in found.items()}
        )
        error, metrics = self._error, {}
        for method, entry in found.items():
            condition = conditions[method]
            others = dict.fromkeys((condition.measured_only.method, reference)) if condition.is_turbo else ()
            changes = {other: paired_change(error[other], error[method]) for other in others if other in conditions}
            metrics[method] = {**condition.description, **entry, "changes": changes, "seconds": seconds[method]}
        return metrics, reference

    def _locating_metrics(self) -> dict[str, Row]:
        own = [(condition, value["located"]) for condition, value in self.evaluated if "located" in value]
        if not own:
            return {}
        weights = {condition.method: found["weights"] for condition, found in reversed(own)}  # of the first repeat
        times = DataFrame([c.columns | found["seconds"] for c, found in own])
        seconds = averaged(times, "method", ("room", "fit", "locate"))
        shares = averaged(self.positions, "method", ("covered", "ambiguous"))
        return {
            method: {
                "position_error_m": entry["error_m"],
                "coverage_80": shares[method]["covered"],
                "ambiguous": shares[method]["ambiguous"],
                "weights": weights[method],
                "seconds": seconds[method],
            }
            for method, entry in summaries(self.positions, "method", ("error_m",)).items()
        }


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
