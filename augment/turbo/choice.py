"""First steps of turbo learning: reference conditions, and the comparison of field models and estimators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from augment.choose import Fold, ModelChoice, choose_model
from augment.cross_validation import (
    STAND_IN,
    cross_validate,
    located_errors,
    located_folds,
    measured_errors,
)
from augment.suggest import suggest
from augment.turbo.condition import NETWORKS, Condition, MeasuredSubset, Row, Training
from augment.turbo.experiment import ROOM_MODEL, Experiment
from augment.turbo.synthesis import Evaluation, RoomSearch, syntheses
from swiftwrf import GeometryModel, InputError, Spectra, load
from swiftwrf.choices import AUTO
from swiftwrf.runtime.steps import STEPS, Step


def first_steps(experiment: Experiment) -> list[Step[Experiment]]:
    """Return the steps from which all others follow."""
    steps = [step for subset in experiment.subsets for step in _first_steps(experiment, subset)]
    suggested = [subset for subset in experiment.subsets if experiment.suggest and subset.repeat == 0]
    return [*steps, *map(Suggestion, suggested)]


def _first_steps(experiment: Experiment, subset: MeasuredSubset) -> list[Step[Experiment]]:
    """Return the reference conditions of a measured subset, and the step that the turbo conditions follow from."""
    fraction, repeat = subset.measured_fraction, subset.repeat
    named = [name for name in experiment.models if name != AUTO]
    compared = tuple(name for name in named if not experiment.model_type(name).slow)

    def reference(estimator: str, training: Training) -> Evaluation:
        return Evaluation(Condition(estimator, training, measured_fraction=fraction, repeat=repeat))

    steps: list[Step[Experiment]] = [
        *(reference(name, "measured") for name in experiment.evaluated if name not in experiment.lacking),
        *(syntheses(experiment, subset, named, {}) if named and not compared else [CrossValidation(subset, compared)]),
    ]
    if ROOM_MODEL in experiment.candidates:
        steps.append(RoomSearch(subset, (), locates=True))
    # independent of the measured fraction, so all fractions share these steps
    return [*steps, *(reference(estimator, "all measured") for estimator in experiment.trainable)]


@dataclass(frozen=True)
class CrossValidation(Step[Experiment]):
    """Compare field models on held-out measured spectra, and determine whether turbo learning helps."""

    subset: MeasuredSubset  # measured spectra
    compared: tuple[str, ...]  # field models; empty for all that are fast and whose requirements the data meet

    title = "comparing field models"

    @property
    def name(self) -> str:
        return f"choice-{self.subset}"

    def compute(self, experiment: Experiment, folder: Path) -> Row:
        measured, _ = experiment.withhold(self.subset)
        seed = experiment.seed_of(self.subset)
        compared = [experiment.own_models.get(name, name) for name in self.compared]
        try:
            choice = choose_model(measured, compared or None, seed=seed, device=experiment.device)
        except InputError:
            if not self.compared:
                raise
            # field models asked for by name need no comparison
            return {"choice": None, "cross_validation": {}}
        trained = [name for name in self.compared if name in choice.folds] or [choice.name]
        validation = {name: cross_validate(choice.folds[name], experiment.n_synthetic, seed) for name in trained}
        first = validation[trained[0]]
        number = experiment.n_extra(first.metrics)
        training: Training = "measured + synthetic + extra" if number else "measured + synthetic"
        turbo = Condition(STAND_IN, training, trained[0], number)
        errors = {Condition(STAND_IN, "measured").method: first.measured_only}
        errors |= {turbo.method: first.turbo} if first.turbo else {}
        folds = choice.folds[trained[0]]
        for name in experiment.evaluated:
            if name not in (*NETWORKS.values(), STAND_IN, *experiment.lacking):
                errors[Condition(name, "measured").method] = [
                    measured_errors(fold, experiment.make_estimator(name, self.subset)) for fold in folds
                ]
        kept = {}  # rooms of folds, and the numbers of their spectra in the data set
        for number, fold in located_folds(self._with_room(experiment, measured, choice)).items():
            file = f"{STEPS}/{self.name}-room{number}.safetensors"
            assert fold.model.room is not None
            fold.model.room.save(folder / file)
            kept[number] = {"file": file, "train": fold.train.index, "test": fold.test.index}
        return {
            "choice": {name: value for name, value in vars(choice).items() if name != "folds"},
            "cross_validation": {name: entry.metrics for name, entry in validation.items()},
            "errors": errors,
            "folds": kept,
        }

    def _with_room(self, experiment: Experiment, measured: Spectra, choice: ModelChoice) -> list[Fold]:
        """Return the folds of a field model with a room, whether such a model was asked for or not; empty without one."""
        folds = next((found for found in choice.folds.values() if found[0].model.room is not None), [])
        if folds or not self.compared or ROOM_MODEL not in experiment.candidates:
            return folds
        try:
            seed = experiment.seed_of(self.subset)
            return choose_model(measured, (ROOM_MODEL,), seed=seed, device=experiment.device).folds[ROOM_MODEL]
        except InputError:
            return []

    def then(self, experiment: Experiment, value: Row) -> Sequence[Step[Experiment]]:
        named = [name for name in experiment.models if name != AUTO]
        followed = syntheses(experiment, self.subset, named or [value["choice"]["name"]], value["cross_validation"])
        located = [
            FoldLocating(self, int(number), entry["file"], tuple(entry["train"]), tuple(entry["test"]))
            for number, entry in value.get("folds", {}).items()
        ]
        return [*followed, *located]


@dataclass(frozen=True)
class FoldLocating(Step[Experiment]):
    """Locate held-out measured spectra of a fold, for the choice of the estimator.

    Training and test spectra of the fold are given by their numbers in the data set.
    """

    compared: CrossValidation
    number: int
    room_file: str
    train: tuple[int, ...]
    test: tuple[int, ...]

    title = "comparing estimators"

    @property
    def name(self) -> str:
        return f"located-fold{self.number}-{self.compared.subset}"

    def compute(self, experiment: Experiment, folder: Path) -> Row:
        measured, _ = experiment.withhold(self.compared.subset)
        room = load(folder / self.room_file)
        assert isinstance(room, GeometryModel)
        train, test = (
            measured.subset(torch.isin(measured.index, torch.tensor(part)).nonzero()[:, 0])
            for part in (self.train, self.test)
        )
        return {"errors": located_errors(Fold(room, train, test), experiment.seed_of(self.compared.subset))}


@dataclass(frozen=True)
class Suggestion(Step[Experiment]):
    """Suggest positions for the next measurements."""

    subset: MeasuredSubset

    @property
    def name(self) -> str:
        return f"suggestion-mix{self.subset.key}"

    @property
    def title(self) -> str:
        return "choosing positions to measure next"

    def compute(self, experiment: Experiment, folder: Path) -> Row:
        measured, _ = experiment.withhold(self.subset)
        found = suggest(measured, experiment.suggest, experiment.seed)
        return {"measured": measured.position, "position": found.position, "variance": found.variance}
