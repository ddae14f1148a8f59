"""First steps of the experiment: reference conditions, and the comparison of field models and estimators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from augment import Fold, ModelChoice, choose_model
from swiftwrf import GeometryModel, InputError, Spectra, load
from swiftwrf.models import FIELD_MODELS
from tasks.aoa.condition import (
    EVERYTHING,
    NETWORKS,
    STAND_IN,
    Condition,
    MeasuredSubset,
    Training,
    estimators,
    trainable,
)
from tasks.aoa.context import ROOM_MODEL, Experiment
from tasks.aoa.cross_validation import cross_validate, located_errors, located_folds, measured_errors
from tasks.aoa.options import AUTO
from tasks.aoa.synthesis import Evaluation, RoomSearch, syntheses
from tasks.claim import STEPS
from tasks.metrics import CrossValidationMetrics
from tasks.records import read_json
from tasks.run import Row
from tasks.steps import Step


def first_steps(experiment: Experiment, subset: MeasuredSubset) -> list[Step[Experiment]]:
    """Return the reference conditions of a measured subset, and the step that the turbo conditions follow from."""
    fraction, repeat = subset.measured_fraction, subset.repeat
    named = [name for name in experiment.config.synthesizer if name != AUTO]
    compared = tuple(name for name in named if not FIELD_MODELS[name].slow)

    def reference(estimator: str, training: Training) -> Evaluation:
        return Evaluation(Condition(estimator, training, measured_fraction=fraction, repeat=repeat))

    steps: list[Step[Experiment]] = [
        *(
            reference(name, "measured")
            for name in estimators(experiment.config.preset)
            if name not in experiment.lacking
        ),
        *(syntheses(experiment, subset, named, {}) if named and not compared else [CrossValidation(subset, compared)]),
    ]
    config, has_room = experiment.config, ROOM_MODEL in experiment.candidates
    if has_room:
        shared = subset == MeasuredSubset(config.mix[0]) and 1.0 not in config.mix
        steps.append(RoomSearch(subset, (), experiment.located_by(subset), EVERYTHING if shared else None))
    # independent of the measured fraction, so all fractions share these steps
    return [*steps, *(reference(estimator, "all") for estimator in trainable(experiment.config.preset))]


@dataclass(frozen=True)
class CrossValidation(Step[Experiment]):
    """Compare field models on held-out measured spectra, and determine whether turbo learning helps.

    Args:
        subset: Measured spectra.
        compared: Names of the field models. Empty for all that are fast and whose requirements the data meet.
    """

    subset: MeasuredSubset
    compared: tuple[str, ...]

    title = "comparing field models"

    @property
    def name(self) -> str:
        return f"choice-{self.subset}"

    def compute(self, experiment: Experiment, folder: Path) -> Row:
        measured, _ = experiment.withhold(self.subset)
        seed = experiment.seed(self.subset)
        try:
            choice = choose_model(measured, self.compared or None, seed=seed, device=experiment.device)
        except InputError:
            if not self.compared:
                raise
            # field models asked for by name need no comparison
            return {"choice": None, "cross_validation": {}}
        trained = [name for name in self.compared if name in choice.folds] or [choice.name]
        validation = {name: cross_validate(choice.folds[name], experiment.n_synthetic, seed) for name in trained}
        first = validation[trained[0]]
        turbo = self._turbo(experiment, trained[0], first.metrics)
        errors = {Condition(STAND_IN, "measured").method: first.measured_only}
        errors |= {turbo.method: first.turbo} if first.turbo else {}
        folds = choice.folds[trained[0]]
        tests = [experiment.with_snapshots(fold.test) for fold in folds]
        for name in estimators(experiment.config.preset):
            if name not in (*NETWORKS.values(), STAND_IN, *experiment.lacking):
                errors[name] = [
                    measured_errors(fold, name, test, seed) for fold, test in zip(folds, tests, strict=True)
                ]
        with_room = self._with_room(experiment, measured, choice)
        return {
            "choice": {
                "name": choice.name,
                "psnr_db": choice.psnr_db,
                "seconds": choice.seconds,
                "left_out": choice.left_out,
            },
            "cross_validation": {name: entry.metrics for name, entry in validation.items()},
            "errors": errors,
            "folds": {number: self._keep(fold, number, folder) for number, fold in located_folds(with_room).items()},
        }

    def _with_room(self, experiment: Experiment, measured: Spectra, choice: ModelChoice) -> list[Fold]:
        """Return the folds of a field model with a room, whether such a model was asked for or not; empty without one."""
        folds = next((found for found in choice.folds.values() if found[0].model.room is not None), [])
        if folds or not self.compared or ROOM_MODEL not in experiment.candidates:
            return folds
        try:
            seed = experiment.seed(self.subset)
            return choose_model(measured, (ROOM_MODEL,), seed=seed, device=experiment.device).folds[ROOM_MODEL]
        except InputError:
            return []

    def _keep(self, fold: Fold, number: int, folder: Path) -> Row:
        """Keep the room of a fold. Return its file, and the numbers of the spectra in the data set."""
        file = f"{STEPS}/{self.name}-room{number}.safetensors"
        assert fold.model.room is not None
        fold.model.room.save(folder / file)
        return {"file": file, "train": fold.train.index, "test": fold.test.index}

    def _turbo(self, experiment: Experiment, synthesizer: str, validation: CrossValidationMetrics) -> Condition:
        """Return the condition of the stand-in with all spectra of a field model."""
        number = experiment.n_extra(validation)
        return Condition(STAND_IN, "turbo_extra" if number else "turbo", synthesizer, number)

    def then(self, experiment: Experiment, value: Row) -> Sequence[Step[Experiment]]:
        named = [name for name in experiment.config.synthesizer if name != AUTO]
        followed = syntheses(experiment, self.subset, named or [value["choice"]["name"]], value["cross_validation"])
        located = [FoldLocating(self, int(number), entry["file"]) for number, entry in value.get("folds", {}).items()]
        return [*followed, *located]


@dataclass(frozen=True)
class FoldLocating(Step[Experiment]):
    """Locate held-out measured spectra of a fold, for the choice of the estimator.

    Args:
        compared: Comparison of field models that has the fold.
        number: Number of the fold.
        room_file: File of the fold's room in the run's directory.
    """

    compared: CrossValidation
    number: int
    room_file: str

    title = "comparing estimators"

    @property
    def name(self) -> str:
        return f"located-fold{self.number}-{self.compared.subset}"

    def compute(self, experiment: Experiment, folder: Path) -> Row:
        measured, _ = experiment.withhold(self.compared.subset)
        entry = read_json(folder / STEPS / f"{self.compared.name}.json")["value"]["folds"][str(self.number)]
        room = load(folder / self.room_file)
        assert isinstance(room, GeometryModel)
        train, test = (
            measured.subset(torch.isin(measured.index, torch.tensor(entry[part])).nonzero()[:, 0])
            for part in ("train", "test")
        )
        return {"errors": located_errors(Fold(room, train, test), experiment.seed(self.compared.subset))}
