"""Results of a run: tables of errors, scores and histories, and the numbers of metrics.json."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from pandas import DataFrame
from torch import Tensor

from augment.cross_validation import LOCATOR, STAND_IN, EstimatorChoiceMetrics, choose_estimator
from swiftwrf.metrics import ChangeMetrics, angle_errors, covered, paired_change
from swiftwrf.models import FIELD_MODELS
from tasks.aoa.condition import EVERYTHING, Condition, MeasuredSubset, pooled, reference_of
from tasks.aoa.context import ROOM_MODEL, Experiment
from tasks.aoa.locating import LEVEL, NO_PLANE, Locating
from tasks.aoa.options import AUTO, fraction_key
from tasks.aoa.steps import CrossValidation, FoldLocating
from tasks.aoa.suggestion import Suggestion
from tasks.aoa.synthesis import Evaluation, RoomSearch, Synthesis, as_bytes
from tasks.metrics import ANGLES, SCORES, LocatingMetrics, MethodMetrics, MixMetrics, SynthesisMetrics
from tasks.run import Row, Run
from tasks.steps import Step
from tasks.summarise import averaged, by_repeat, summaries
from tasks.terminal import console, terminal

EXAMPLE_QUANTILES = (
    1.0,
    0.8,
    0.6,
    0.4,
    0.2,
    0.0,
)  # of the PSNR at the test positions, from the best spectrum to the worst


class Results:
    """Results of the steps of a run.

    Args:
        experiment: Data and options of the run.
        run: Directory of the run.
    """

    def __init__(self, experiment: Experiment, run: Run) -> None:
        self.experiment, self.test, self.run = experiment, experiment.test, run
        self.evaluated: list[tuple[Condition, Row]] = []
        self.synthesis: list[Row] = []  # scores of each test spectrum
        self.synthesis_seconds: list[Row] = []
        self.history: list[Row] = []
        self.chosen: dict[str, Row] = {}  # by measured fraction, of the first repeat
        self.located_folds: dict[str, dict[int, list[float] | None]] = {}  # errors by fold, in the same way
        self.left_out: dict[Condition, str] = {}  # conditions of matched-field processing, and why
        self._examples: set[str] = set()
        self._sentences: set[str] = set()
        fractions = [MeasuredSubset(fraction) for fraction in experiment.config.mix]
        for name, reason in experiment.lacking.items():
            self.left_out |= {Condition(name, "measured", **subset.columns): reason for subset in fractions}
        for reason in dict.fromkeys(experiment.lacking.values()):
            names = ", ".join(name for name, own in experiment.lacking.items() if own == reason)
            console.print(f"left out: {names}, because {reason}")
        if missing := FIELD_MODELS[ROOM_MODEL].lacking(self.test):
            reason = f"it needs the {missing[0]}, which {self.test.name} does not describe"
            console.print(f"{LOCATOR} is left out: {reason}")
            located = (c for subset in (*fractions, EVERYTHING) for c in experiment.located_by(subset))
            self.left_out |= dict.fromkeys(located, reason)

    def add(self, step: Step[Experiment], value: Row) -> None:
        """Add the result of one step."""
        match step:
            case CrossValidation():
                self.chosen.setdefault(step.subset.key, value)
            case FoldLocating() if step.compared.subset.repeat == 0:
                self.located_folds.setdefault(step.compared.subset.key, {})[step.number] = value["errors"]
            case Synthesis() if "refused" in value:
                console.print(f"{step.synthesizer} is left out of the comparison: {value['refused']}")
            case Synthesis():
                self._add_synthesis(step, value)
            case RoomSearch() if not value.get("planes"):
                self._leave_out(step.located, value.get("refused", NO_PLANE))
            case Locating() if "refused" in value:
                self._leave_out((step.condition,), value["refused"])
            case Evaluation() | Locating():
                self.evaluated.append((step.condition, value))
                self.history += [step.condition.columns | row for row in value["history"]]
            case Suggestion():
                self._add_suggestion(step, value)

    def show(self, step: Step[Experiment], value: Row) -> None:
        """Show the median angular error of a condition on the terminal."""
        if not isinstance(step, Evaluation | Locating) or "refused" in value:
            return
        condition = step.condition
        error = angle_errors(torch.tensor(value["estimate"], dtype=torch.float64), self.test.label)["great_circle"]
        name = f"{condition.estimator}, {condition.meaning}"
        if condition.training != "all" and len(self.experiment.config.mix) > 1:
            name = f"{condition.measured_fraction:.0%}: {name}"
        terminal.result(name, f"{float(error.nanquantile(0.5).rad2deg()):.2f} deg")

    @property
    def pooled(self) -> list[tuple[Condition, Row]]:
        """Results by condition, such that each condition has all repeats."""
        return pooled(self.evaluated, self.experiment.config.synthesizer == (AUTO,))

    def write(self) -> None:
        """Write the tables of the run."""
        self.run.write_csv("errors.csv", self.errors())
        if positions := self.positions():
            self.run.write_csv("positions.csv", positions)
        self.run.write_csv("synthesis.csv", self.synthesis)
        self.run.write_csv("history.csv", self.history)

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
            rows += _rows(condition.columns, columns)
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
            rows += _rows(condition.columns, columns)
        return rows

    def _leave_out(self, conditions: Iterable[Condition], reason: str) -> None:
        """Record and print why conditions are not in the results, each sentence once."""
        for condition in conditions:
            share = "everything" if condition.training == "all" else f"{condition.measured_fraction:.0%}"
            sentence = f"{condition.method} is left out with {share} measured: {reason}"
            if sentence not in self._sentences:
                console.print(sentence)
            self._sentences.add(sentence)
            self.left_out[condition] = reason

    def _add_synthesis(self, step: Synthesis, value: Row) -> None:
        key = step.subset.columns | {"synthesizer": step.synthesizer}
        columns = {score: torch.tensor(values) for score, values in value["scores"].items()}
        self.synthesis += _rows(key, {"index": self.test.index} | columns)
        self.synthesis_seconds.append(key | value["seconds"] | {"trains": step.trains})
        self.history += [key | row for row in value["history"]]
        if step.subset.repeat == 0 and step.trains and step.subset.key not in self._examples:
            self._examples.add(step.subset.key)
            self._write_examples(step, torch.tensor(value["scores"]["psnr_db"]))

    def _add_suggestion(self, step: Suggestion, value: Row) -> None:
        name = f"suggested-mix{step.subset.key}"
        tensors = {key: torch.tensor(value[key], dtype=torch.float64) for key in ("measured", "position", "variance")}
        coordinates = dict(zip(("x_m", "y_m", "z_m"), tensors["position"].T, strict=True))
        self.run.write_csv(f"{name}.csv", _rows({}, coordinates | {"variance_left": tensors["variance"][1:]}))
        names = {"measured": "measured", "suggested": "position", "left": "variance"}
        self.run.write_npz(f"{name}.npz", {array: tensors[key].numpy() for array, key in names.items()})

    def _write_examples(self, step: Synthesis, score: Tensor) -> None:
        """Write measured and synthetic spectra at the test positions with given quantiles of their PSNR (n,)."""
        spectra = step.test_spectra(self.run.folder)
        measured, synthetic = self.test.store, spectra["test"]
        order = score.argsort()
        chosen = order[[round(q * (len(order) - 1)) for q in EXAMPLE_QUANTILES]]
        examples = {
            "measured": as_bytes(measured[chosen]).numpy(),
            "synthetic": as_bytes(synthetic[chosen]).numpy(),
            "synthesizer": step.synthesizer,
            "index": self.test.index[chosen].numpy(),
            "psnr_db": score[chosen].numpy(),
        }
        if "test_std" in spectra:
            std = spectra["test_std"]
            examples["deviation"] = as_bytes(std[chosen]).numpy()
            triples = zip(synthetic.batches(), measured.batches(), std.batches(), strict=True)
            examples["coverage"] = float(torch.cat([covered(s, d, m) for s, m, d in triples]).mean())
        self.run.write_npz(f"examples-mix{step.subset.key}.npz", examples)

    def summary(self, fraction: float) -> MixMetrics:
        """Return the numbers of metrics.json for one measured fraction."""
        chosen = self.chosen.get(fraction_key(fraction), {})
        evaluated = [(c, value) for c, value in self.evaluated if c.measured_fraction == fraction]
        synthesis, fits = (
            DataFrame([row for row in rows if row["measured_fraction"] == fraction])
            for rows in (self.synthesis, self.synthesis_seconds)
        )
        trained = fits[fits["trains"]]
        methods, reference = self._method_metrics(fraction)
        return {
            "n_measured": round(fraction * len(self.experiment.train)),
            "counts": {condition.training_set: value["counts"] for condition, value in evaluated},
            "choice": chosen.get("choice"),
            "cross_validation": chosen.get("cross_validation"),
            "estimator_choice": self._estimator_choice(fraction),
            "synthesis": _synthesis_metrics(synthesis, fits),
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
            located = {}  # its fit to all measured spectra was refused
        choice = choose_estimator(errors, {n: None if own is None else np.array(own) for n, own in located.items()})
        return {**choice, "better": self._better(fraction, choice)}

    def _better(self, fraction: float, choice: EstimatorChoiceMetrics) -> dict[str, str]:
        """Return the methods that are significantly better than the chosen one on the test spectra, and why not chosen."""
        errors = DataFrame([row for row in self.errors() if row["measured_fraction"] == fraction])
        error = {method: by_repeat(part, "great_circle_deg") for method, part in errors.groupby("method")}
        reasons = {}
        for condition, _ in self.pooled:
            if condition.measured_fraction != fraction or condition.training == "all":
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

    def _method_metrics(self, fraction: float) -> tuple[dict[str, MethodMetrics], str]:
        """Return the metrics of each method, and the reference of changes."""
        own = [(condition, value) for condition, value in self.pooled if condition.measured_fraction == fraction]
        conditions = {condition.method: condition for condition, _ in reversed(own)}  # of the first repeat
        errors = DataFrame([row for row in self.errors() if row["measured_fraction"] == fraction])
        seconds = averaged(
            DataFrame([c.columns | value["seconds"] for c, value in own]), "method", ("train", "estimate")
        )
        found = summaries(errors, "method", ANGLES)
        reference = reference_of(
            conditions, {name: entry["great_circle_deg"]["median"] for name, entry in found.items()}
        )
        changes = _changes(errors, conditions, reference)
        metrics = {
            method: {**conditions[method].description, **entry, "changes": changes[method], "seconds": seconds[method]}
            for method, entry in found.items()
        }
        return metrics, reference  # type: ignore[return-value]

    def _locating_metrics(self, fraction: float) -> dict[str, LocatingMetrics]:
        rows = DataFrame([row for row in self.positions() if row["measured_fraction"] == fraction])
        if not len(rows):
            return {}
        located = [(c, value["located"]) for c, value in self.evaluated if "located" in value]
        own = [(c, found) for c, found in located if c.measured_fraction == fraction]
        weights = {c.method: found["weights"] for c, found in reversed(own)}  # of the first repeat
        seconds = averaged(
            DataFrame([c.columns | found["seconds"] for c, found in own]), "method", ("room", "fit", "locate")
        )
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


def _changes(
    errors: DataFrame, conditions: dict[str, Condition], reference: str
) -> dict[str, dict[str, ChangeMetrics]]:
    """Return the changes of the angular error by synthetic spectra of each method, by the method that it is compared to."""
    error = {method: by_repeat(part, "great_circle_deg") for method, part in errors.groupby("method")}
    compared = {
        method: [other for other in dict.fromkeys((condition.measured_only.method, reference)) if other in conditions]
        if condition.is_turbo
        else []
        for method, condition in conditions.items()
    }
    return {
        method: {other: paired_change(error[other], error[method]) for other in others}
        for method, others in compared.items()
    }


def _synthesis_metrics(scores: DataFrame, seconds: DataFrame) -> dict[str, SynthesisMetrics]:
    spent = averaged(seconds, "synthesizer", ("fit", "synthesize"))
    return {
        name: {**entry, "seconds": spent[name]}  # type: ignore[typeddict-item]
        for name, entry in summaries(scores, "synthesizer", SCORES).items()
    }


def _rows(key: Row, columns: dict[str, Tensor]) -> list[Row]:
    lists = {name: column.tolist() for name, column in columns.items()}
    return [key | dict(zip(lists, values, strict=True)) for values in zip(*lists.values(), strict=True)]
