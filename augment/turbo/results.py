"""Result of turbo learning: errors of each condition and test spectrum, scores, histories, and their summaries."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pandas import DataFrame, concat

from augment.choices import fraction_key
from augment.cross_validation import LOCATOR, choose_estimator
from augment.estimators import Estimator
from augment.turbo.artifacts import model_file
from augment.turbo.condition import (
    LOCATED,
    Condition,
    MeasuredSubset,
    Row,
    conditions_of,
    pooled,
    reference_of,
)
from augment.turbo.experiment import ROOM_MODEL, Experiment
from augment.turbo.stages import training_set
from swiftwrf import load
from swiftwrf.contrib.comparison.base import Recorded, Result
from swiftwrf.contrib.comparison.errors import ChangeMetrics, paired_change, summaries
from swiftwrf.contrib.comparison.steps import Memo
from swiftwrf.data.splits import places
from swiftwrf.locate import MatchedField
from swiftwrf.metrics import LEVEL, angle_errors
from swiftwrf.models import FIELD_MODELS

ANGLES = ("azimuth_deg", "elevation_deg", "great_circle_deg")


class TurboResult(Result):
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
        >>> result.choice["name"] in result.summary().index, result.best.is_fitted
        (True, True)
    """

    def __init__(self, experiment: Experiment, fraction: float, keep: Memo) -> None:
        self.experiment, self.fraction, self._keep = experiment, fraction, keep
        self.compared: Row = {}  # comparison of the field models in the first repeat
        # in the first repeat: errors [deg] of its methods on held-out spectra, and names of the files of its methods
        self.held_out: dict[str, list[float]] = {}
        self.files = {LOCATED: LOCATOR}
        self.synthesized: list[tuple[Row, Row]] = []  # columns and values of each field model
        self.evaluated: list[tuple[Condition, Row]] = []
        self.history: list[Row] = []
        # columns of each test spectrum in all tables
        self._rows = {"index": experiment.test.index, "place": places(experiment.test.position, 2)}
        self.missing: dict[str, str] = {}  # reason for each method that is missing
        self.left_out: list[str] = []
        for name, reason in experiment.lacking.items():
            names = ", ".join(name for name, own in experiment.lacking.items() if own == reason)
            self.leave_out(Condition(name, "measured").method, f"left out: {names}, because {reason}", reason)
        if missing := FIELD_MODELS[ROOM_MODEL].lacking(experiment.test):
            reason = f"it needs the {missing[0]}, which {experiment.test.name} does not describe"
            self.leave_out(LOCATED, f"{LOCATOR} is left out: {reason}", reason)

    @property
    def folder(self) -> Path:
        """Folder of the files that the steps wrote."""
        return self._keep.folder

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
        key = {"measured_fraction": subset.measured_fraction, "repeat": subset.repeat, "synthesizer": name}
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
                **self._rows,
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
            if (located := value.get("located")) is None:
                continue
            estimate = torch.tensor(located["position"], dtype=torch.float64)
            columns: Row = dict(self._rows)
            for name, at in (("truth", test.position), ("estimate", estimate)):
                columns |= {f"{name}_{axis}_m": at[:, number] for number, axis in enumerate("xyz")}
            columns |= {
                "error_m": (estimate - test.position).norm(dim=1),
                "credible_radius_80_m": located["radius"],
                "covered": np.array(located["level"]) < LEVEL,
                "containing_level": located["level"],
                "ambiguous": located["ambiguous"],
            }
            tables.append(DataFrame(condition.columns | columns))
        return concat(tables, ignore_index=True)

    @cached_property
    def synthesis(self) -> DataFrame:
        """A row for each field model and test spectrum: PSNR [dB], SSIM and L1."""
        tables = [DataFrame(key | self._rows | value["scores"]) for key, value in self.synthesized]
        return concat(tables, ignore_index=True)

    @cached_property
    def metrics(self) -> Row:
        """Numbers of metrics.json for the measured fraction.

        Returns:
            n_measured: Number of measured spectra.
            counts: Spectra by origin in each training set.
            choice: Chosen field model, trimmed mean PSNR [dB] and seconds of each candidate, and reasons why others could
                not be fitted. This and the next two are of the first repeat, None without a comparison.
            cross_validation: Change of the error by extra synthetic spectra, by field model; see `cross_validate`.
            estimator_choice: Choice by the errors on held-out measured spectra, see `choose_estimator`; the `file` of the
                chosen estimator; and `better`: the methods with a significantly smaller error on the test spectra, or a
                smaller one and none on held-out spectra, best first, and why they are not chosen.
            synthesis: Quality of each field model at the test positions, and its mean seconds to `fit` and `synthesize`.
            methods: Condition, errors, mean seconds and `changes` of each method. These are changes of the angular error by
                synthetic spectra, by the method that it is compared to: the same estimator on measured spectra, and the
                reference. Their intervals are paired over test places.
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
        choice: Row | None = self.metrics["estimator_choice"]
        return choice

    @cached_property
    def best(self) -> Estimator | MatchedField | None:
        """The estimator that cross-validation chose, as the first repeat trained it. None if nothing was compared."""
        if self.choice is None:
            return None
        if self.choice["file"]:
            saved = load(self.folder / self.choice["file"])
            assert isinstance(saved, Estimator | MatchedField)
            return saved
        assert self.chosen is not None
        (own, _), experiment = self.chosen, self.experiment
        estimator = experiment.make_estimator(own.estimator, 0)
        return estimator.fit(training_set(experiment, self.folder, own), device=experiment.device)

    @cached_property
    def chosen(self) -> tuple[Condition, Row] | None:
        """Condition of the first repeat that held-out spectra chose, and their choice. None if none were held out."""
        own = {id(value): condition for condition, value in self.evaluated}
        # methods have other names than in the first repeat if other repeats chose another field model
        first = {condition.method: own[id(value)] for condition, value in self.pooled if condition.repeat == 0}
        held_out = {method: self.held_out.get(condition.method) for method, condition in first.items()}
        errors = {method: np.array(values) for method, values in held_out.items() if values}
        if not errors:
            return None
        parts = self.experiment.parts(MeasuredSubset(self.fraction))
        position = torch.cat([self.experiment.held_out(part)[1].position for part in parts])
        choice = choose_estimator(errors, places(position, 2))
        return first[choice["name"]], choice

    def summary(self) -> DataFrame:
        """Return a row for each method, the smallest median first.

        `median`, `p90`, and `low` and `high` of the median's 95 % interval are those of the angle between true and estimated
        direction [deg]. `change` [%] is that of the median by synthetic spectra, relative to the same estimator on the
        measured spectra alone. Its interval, `change_low` and `change_high`, is paired over the places of the test spectra.
        """
        conditions = conditions_of(self.metrics["methods"])
        rows: list[Row] = []
        for method, entry in self.metrics["methods"].items():
            error = entry["great_circle_deg"]
            change = entry["changes"].get(conditions[method].measured_only.method)
            row: Row = {name: error[name] for name in ("median", "low", "high", "p90")}
            if change is not None:
                columns = {"change": "change", "change_low": "low", "change_high": "high"}
                row |= {column: 100 * change[name] for column, name in columns.items()}
            rows.append(row)
        return DataFrame(rows, index=list(self.metrics["methods"])).sort_values("median")

    def recorded(self, *others: TurboResult) -> Recorded:
        """Return the content of the files of a run with this result, and with those of other measured fractions."""
        experiment, results = self.experiment, (self, *others)
        train, test = experiment.train, experiment.test
        metrics = {
            "task": "aoa",
            "data": train.name,
            "split": experiment.split,
            "preset": experiment.preset,
            "seed": experiment.seed,
            "repeats": experiment.repeats,
            "moving": train.moving,
            "notes": list(train.notes),
            "extra": experiment.n_synthetic,
            "n_train": len(train),
            "n_test": len(test),
            "grid": train.grid.shape,
            "line_of_sight_share": float(test.line_of_sight.float().mean()),
            "mixes": {fraction_key(result.fraction): result.metrics for result in results},
        }
        names = ("errors", "synthesis", "positions")
        tables = {name: concat([getattr(result, name) for result in results]) for name in names}
        # the columns of rows differ, and integers stay integers
        tables["history"] = DataFrame([row for result in results for row in result.history], dtype=object)
        tables = {name: table for name, table in tables.items() if len(table) or name != "positions"}
        return Recorded(metrics, tables, {}, train.source, self.folder)

    def __repr__(self) -> str:
        error = self.summary()["median"]
        chosen = f", chosen: {self.choice['name']}" if self.choice else ""
        return f"<TurboResult: {len(error)} methods, best {error.index[0]} at {error.iloc[0]:.2f} degrees{chosen}>"

    @cached_property
    def _error(self) -> dict[str, NDArray[np.float64]]:
        """Angular errors [deg] of each method, (n, repeats)."""
        columns = {"index": "index", "columns": "repeat", "values": "great_circle_deg"}
        return {method: part.pivot(**columns).to_numpy(float) for method, part in self.errors.groupby("method")}

    def _change(self, before: str, after: str) -> ChangeMetrics:
        """Return the change of the angular error between two methods, paired over the places of the test spectra."""
        place = self._rows["place"][self._rows["index"].argsort()]
        return paired_change(self._error[before], self._error[after], place)

    def _estimator_choice(self) -> Row | None:
        """Return the choice of the estimator, its file, and why better methods are not chosen."""
        if self.chosen is None:
            return None
        condition, choice = self.chosen
        file = model_file(self.folder, self.files.get(condition.method, ""), fraction_key(self.fraction))
        return choice | {"better": self._better(choice), "file": file.name if file.is_file() else None}

    def _better(self, choice: Row) -> dict[str, str]:
        """Return the methods that are better than the chosen one on the test spectra, and why they are not chosen.

        Methods that were compared on held-out spectra count if they are significantly better, others in any case.
        """
        error, held_out, name, reasons = self._error, choice["held_out_deg"], choice["name"], dict[str, str]()
        slow = [name for name in self.experiment.named if self.experiment.model_type(name).slow]
        for condition, _ in self.pooled:
            method, is_compared = condition.method, condition.method in held_out
            change = self._change(name, method)["high" if is_compared else "change"]
            if condition.training == "all measured" or change >= 0:
                continue
            if is_compared:
                measure = "median" if held_out[method] > held_out[name] else "mean"
                reason = f"its {measure} error on held-out measured spectra is larger"
            elif (condition.is_network and self.experiment.preset == "paper") or condition.synthesizer in slow:
                reason = "its training takes too long to be repeated without the held-out spectra"
            else:
                reason = "it cannot be fitted without the held-out spectra"
            reasons[method] = reason
        return {method: reasons[method] for method in sorted(reasons, key=lambda one: float(np.median(error[one])))}

    def _method_metrics(self) -> tuple[dict[str, Row], str]:
        """Return the metrics of each method, and the reference of changes."""
        conditions = {condition.method: condition for condition, _ in reversed(self.pooled)}  # of the first repeat
        times = DataFrame([c.columns | value["seconds"] for c, value in self.pooled])
        seconds = averaged(times, "method", ("train", "estimate"))
        errors = summaries(self.errors, "method", ANGLES)
        reference = reference_of(
            conditions, {name: entry["great_circle_deg"]["median"] for name, entry in errors.items()}
        )
        metrics = {}
        for method, entry in errors.items():
            condition = conditions[method]
            others = dict.fromkeys((condition.measured_only.method, reference)) if condition.is_turbo else ()
            changes = {other: self._change(other, method) for other in others if other in conditions}
            metrics[method] = {**condition.description, **entry, "changes": changes, "seconds": seconds[method]}
        return metrics, reference

    def _locating_metrics(self) -> dict[str, Row]:
        own = [(condition, value["located"]) for condition, value in self.evaluated if "located" in value]
        if not own:
            return {}
        weights = {condition.method: located["weights"] for condition, located in reversed(own)}  # of the first repeat
        times = DataFrame([c.columns | located["seconds"] for c, located in own])
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


def averaged(table: DataFrame, by: str, columns: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the mean of each column for each value of `by`."""
    means: dict[str, dict[str, float]] = table.groupby(by, sort=False)[list(columns)].mean().to_dict("index")
    return means
