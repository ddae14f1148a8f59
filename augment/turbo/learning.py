"""Turbo learning in one call, on spectra in memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from pandas import DataFrame

from augment.cross_validation import LOCATOR, EstimatorChoiceMetrics
from augment.estimators import Estimator
from augment.turbo.choice import first_steps
from augment.turbo.condition import Condition, Row, chosen_file, conditions_of
from augment.turbo.experiment import ROOM_MODEL, Experiment
from augment.turbo.results import Results
from augment.turbo.synthesis import Evaluation
from swiftwrf.choices import AUTO, fraction_key
from swiftwrf.data import Spectra
from swiftwrf.errors import InputError
from swiftwrf.locate import MatchedField
from swiftwrf.models import FieldModel
from swiftwrf.runtime.checkpoint import load
from swiftwrf.runtime.durable import strict
from swiftwrf.runtime.steps import STEPS, Step, walk
from swiftwrf.runtime.validation import NonNegativeInt, PositiveInt, Preset, checked


class TurboResult:
    """Errors of estimators trained on measured, synthetic and all spectra, and the one that cross-validation chose.

    Attributes:
        errors: A row for each condition and test spectrum: estimator, training set, truth, estimate and errors [deg].
        positions: A row for each condition that locates and test spectrum: truth, estimate and error [m].
        metrics: All summaries, as in metrics.json of a run: errors with intervals, paired changes, quality of the synthetic
            spectra, choices, times.
        best: The estimator that cross-validation on the measured spectra chose, trained. None if nothing was compared.
        left_out: A sentence for each method that is missing.

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.simulated_room(n=40, grid=swiftwrf.AngularGrid.hemisphere(10, 40))
        >>> result = turbo_learning(data, measured=0.5, models=["nearest"], estimators=["peak"], extra=0)
        >>> result.choice["name"], type(result.best).__name__
        ('kernel_regression, measured', 'KernelRegression')
    """

    def __init__(self, results: Results, metrics: Row, best: Estimator | MatchedField | None) -> None:
        self.errors, self.positions = DataFrame(results.errors()), DataFrame(results.positions())
        self.metrics, self.best, self.left_out = metrics, best, results.notes

    @property
    def choice(self) -> EstimatorChoiceMetrics | None:
        """Choice of the estimator by cross-validation; `choice["name"]` is its method. None if nothing was compared."""
        found: EstimatorChoiceMetrics | None = self.metrics["estimator_choice"]
        return found

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
                row |= {
                    "change": 100 * change["change"],
                    "change_low": 100 * change["low"],
                    "change_high": 100 * change["high"],
                }
            rows.append(row)
        return DataFrame(rows, index=list(self.metrics["methods"])).sort_values("median")

    def __repr__(self) -> str:
        error = self.summary()["median"]
        chosen = f", chosen: {self.choice['name']}" if self.choice else ""
        return f"<TurboResult: {len(error)} methods, best {error.index[0]} at {error.iloc[0]:.2f} degrees{chosen}>"


@checked
def turbo_learning(
    data: Spectra,
    *,
    measured: float = 0.3,
    split: str = "random",
    models: str | Sequence[str | FieldModel] = AUTO,
    estimators: Sequence[str | Estimator] | None = None,
    extra: NonNegativeInt | None = None,
    preset: Preset = "quick",
    repeats: PositiveInt = 1,
    seed: NonNegativeInt = 0,
    device: torch.device | str = "cpu",
) -> TurboResult:
    """Train estimators on few measured spectra, on these and synthetic ones, and on all, and compare their errors.

    A part of the training spectra counts as measured. Field models fitted to it predict spectra at the withheld positions
    and at extra ones. Errors are those on the test part of the split, which takes no part in any fit or choice.

    Args:
        data: Labelled spectra.
        measured: Fraction of the training spectra that counts as measured, in (0, 1].
        split: Split that comes with the data, or a seeded one: random or block.
        models: Field models of the synthetic spectra: names, models of your own, or "auto" for the one that predicts
            held-out measured spectra best.
        estimators: Estimators beside kernel regression: names such as "aann_kernel", or estimators of your own.
            Defaults to all, and to a comparison of all fast field models.
        extra: Number of extra synthetic positions. Defaults to 3,000 where cross-validation recommends some.
        preset: "quick", or "paper" for the sizes of the publication.
        repeats: Number of random measured subsets, whose errors are pooled.
        seed: Seed of everything random.
        device: Device to compute on.

    Raises:
        InputError: A split, name or fraction that does not exist, or data that do not suffice.
        FitError: A fit diverged.

    Source:
        M. Liu et al., "Deformable 2D Gaussian Splatting for Efficient Wireless Radiance Field Rendering", 2025: the case
        study on angle of arrival.

    Example:
        >>> import swiftwrf
        >>> data = swiftwrf.simulated_room(n=40, grid=swiftwrf.AngularGrid.hemisphere(10, 40))
        >>> result = turbo_learning(data, measured=0.5, models=["idw"], estimators=["peak"], extra=0)
        >>> bool(result.summary().loc["kernel_regression, measured", "median"] < result.summary().loc["peak", "median"])
        True
    """
    models = (models,) if isinstance(models, str) else models
    own_models = {model.name: model for model in models if isinstance(model, FieldModel)}
    own_estimators = {type(one).__name__: one for one in estimators or () if isinstance(one, Estimator)}
    names = tuple(one if isinstance(one, str) else one.name for one in models)
    named = tuple(one for one in estimators or () if isinstance(one, str))
    _check_unique("field models", names)
    _check_unique("estimators", [one if isinstance(one, str) else type(one).__name__ for one in estimators or ()])
    train, test = data.split(split, seed)
    experiment = Experiment(
        train,
        test,
        (measured,),
        names,
        None if estimators is None else tuple(name for name in named if name != LOCATOR),
        None if estimators is None else (ROOM_MODEL,) * (LOCATOR in named),
        own_models,
        own_estimators,
        extra,
        preset,
        repeats,
        seed,
        device=device,
    )
    results, known, steps = Results(experiment), dict[str, Any](), list[Step[Experiment]]()
    with TemporaryDirectory(prefix="swiftwrf-") as name:
        folder = Path(name)
        (folder / STEPS).mkdir()

        def compute(step: Step[Experiment]) -> Row:
            if step.name not in known:
                known[step.name] = strict(step.compute(experiment, folder))
            value: Row = known[step.name]
            return value

        for step, value in walk(first_steps(experiment), experiment, compute):
            results.add(step, value)
            steps.append(step)
        metrics = results.summary(measured)
        choice = metrics["estimator_choice"]
        condition = conditions_of(metrics["methods"])[choice["name"]] if choice else None
        best = None if condition is None else _trained(condition, experiment, steps, folder)
        return TurboResult(results, metrics, best)


def _check_unique(things: str, names: Sequence[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two {things} have the name {name!r}; leave one out, or give it another name")


def _trained(
    condition: Condition, experiment: Experiment, steps: Sequence[Step[Experiment]], folder: Path
) -> Estimator | MatchedField | None:
    """Return the estimator of a condition as the first repeat trained it: from its file, or trained again without one."""
    if file := chosen_file(folder, fraction_key(experiment.fractions[0]), condition):
        found = load(file)
        assert isinstance(found, Estimator | MatchedField)
        return found
    evaluations = (step for step in steps if isinstance(step, Evaluation) and step.subset.repeat == 0)
    own = next((step for step in evaluations if step.condition.method == condition.method), None)
    if own is None:
        return None
    estimator = experiment.make_estimator(condition.estimator, own.subset)
    return estimator.fit(own.training_set(experiment, folder), device=experiment.device)
