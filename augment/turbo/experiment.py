"""Data and options that all steps of turbo learning share."""

from __future__ import annotations

import re
from collections.abc import Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from augment.choices import AUTO
from augment.choose import blind_folds, candidates, held_out
from augment.cross_validation import LOCATOR, STAND_IN
from augment.estimators import ESTIMATORS, Estimator, make_estimator
from augment.mix import Mixed, withhold
from augment.positions import SyntheticPositions
from augment.turbo.condition import NETWORKS, MeasuredSubset, Row, Training
from swiftwrf.data import Spectra
from swiftwrf.errors import InputError
from swiftwrf.locate.matched_field import MIN_SPECTRA
from swiftwrf.metrics import WINDOW, too_small
from swiftwrf.models import FIELD_MODELS, FieldModel
from swiftwrf.models.base import model_type
from swiftwrf.runtime.validation import Preset

ROOM_MODEL = "geometry"  # field model that finds the room for all models with one
DEFAULT_EXTRA = 3000  # extra synthetic positions where cross-validation recommends some
MIN_HELD_OUT, MAX_HELD_OUT = 20, 120  # spectra that all methods are compared on at once; more take longer to locate


@dataclass(frozen=True, eq=False)
class Experiment:
    """Data and options that all steps of turbo learning share.

    Raises:
        InputError: No test spectra, fewer pixels than SSIM needs, a fraction that leaves too few spectra, an unknown
            name, or data that lack what a model or `extra` needs.
    """

    train: Spectra
    test: Spectra
    fractions: tuple[float, ...] = (0.3,)  # of the training spectra that count as measured, in (0, 1]
    models: Sequence[str | FieldModel] = (AUTO,)  # whose spectra train estimators: names and objects, or "auto" alone
    estimators: Sequence[str | Estimator] | None = None  # beside kernel regression; None for all
    extra: int | None = None  # most extra synthetic positions; None for 3,000 where cross-validation recommends some
    preset: Preset = "quick"  # sizes of models and network
    repeats: int = 1  # each with its own measured spectra and seed
    seed: int = 0
    device: torch.device | str = "cpu"
    split: str = "random"  # name of the split that gave training and test spectra

    def __post_init__(self) -> None:
        data = self.test
        if len(data) == 0:
            raise InputError(f"this split of {data.name} has no test spectra")
        if too_small(data.grid.shape):
            raise InputError(
                f"spectra of {data.name} have {data.grid.shape[0]} x {data.grid.shape[1]} pixels; SSIM, the measure "
                f"of their quality, needs at least {WINDOW} x {WINDOW} or a row of {WINDOW}"
            )
        for part in (self.train, data):
            Mixed.measured(part)  # refuses spectra without directions
        if not self.models:
            raise InputError("models is empty; name at least one, or give 'auto'")
        for name in self.named:
            if not re.fullmatch(r"\w[\w .+-]*", name):  # files have it in their names
                raise InputError(f"a field model needs a name that begins with a letter, without slashes, got {name!r}")
            if missing := self.model_type(name).lacking(data):
                hint = "give it with --array" if "array" in missing else "the data must contain its position"
                raise InputError(
                    f"synthesizer {name} needs the {missing[0]}, which {data.name} does not describe; {hint}"
                )
        for name in self._estimators:
            if name not in (*self._own_estimators, LOCATOR):
                ESTIMATORS.check(name)
        for things, names in (("field models", self._models), ("estimators", self._estimators)):
            for name in names:
                if names.count(name) > 1:
                    raise InputError(f"two {things} have the name {name!r}; leave one out, or give it another name")
        if self.extra:
            data.direction_at(data.position[:1])  # refuses unknown geometry
        for fraction in self.fractions:
            withhold(self.train, fraction, self.seed)

    @property
    def _models(self) -> list[str]:
        return [model if isinstance(model, str) else model.name for model in self.models]

    @property
    def _estimators(self) -> list[str]:
        return [one if isinstance(one, str) else type(one).__name__ for one in self.estimators or ()]

    @property
    def _own_estimators(self) -> dict[str, Estimator]:
        return {type(one).__name__: one for one in self.estimators or () if not isinstance(one, str)}

    @property
    def own_models(self) -> dict[str, FieldModel]:
        """Field models of the user by name."""
        return {model.name: model for model in self.models if not isinstance(model, str)}

    @property
    def named(self) -> list[str]:
        """Field models that are asked for. Empty where cross-validation chooses one."""
        return [name for name in self._models if name != AUTO]

    @property
    def n_synthetic(self) -> int:
        """Largest number of extra synthetic positions."""
        known = self.test.fixed_position is not None and self.test.rotation is not None
        return self.extra if self.extra is not None else DEFAULT_EXTRA if known else 0

    @property
    def subsets(self) -> list[MeasuredSubset]:
        """Measured subsets of all fractions and repeats."""
        return [MeasuredSubset(fraction, repeat) for repeat in range(self.repeats) for fraction in self.fractions]

    def withhold(self, subset: MeasuredSubset) -> tuple[Spectra, SyntheticPositions]:
        """Return the measured spectra, less those that are held out, and the positions that are not measured."""
        measured, withheld = withhold(self.train, subset.measured_fraction, self.seed + subset.repeat)
        return self.held_out(subset)[0] if subset.without else measured, withheld

    def blind_folds(self, subset: MeasuredSubset) -> tuple[Tensor, tuple[tuple[int, ...], ...]]:
        """Return the fold of each measured spectrum, and the folds that each search for a room leaves out."""
        return blind_folds(self.withhold(replace(subset, without=()))[0], "random", self.seed + subset.repeat)

    def held_out(self, subset: MeasuredSubset) -> tuple[Spectra, Spectra]:
        """Return the measured spectra less those that the subset holds out, and at most 120 of the latter."""
        whole = replace(subset, without=())
        return held_out(self.withhold(whole)[0], self.blind_folds(whole)[0], subset.without, MAX_HELD_OUT)

    def parts(self, subset: MeasuredSubset) -> list[MeasuredSubset]:
        """Return the subset less spectra that methods are compared on, once or twice; no part if too few are measured."""
        blind = self.blind_folds(subset)[1][:2]
        parts = [replace(subset, without=folds) for folds in blind]
        if not parts or len(self.withhold(parts[0])[0]) < MIN_SPECTRA:  # of the locator
            return [replace(subset, without=folds[:1]) for folds in blind]
        return parts[:1] if len(self.held_out(parts[0])[1]) >= MIN_HELD_OUT else parts

    def trainings(self, validation: Row | None) -> list[tuple[Training, int]]:
        """Return the training sets with spectra of a field model, and their numbers of extra synthetic positions."""
        # by default only where held-out measured spectra gain from extra positions
        wanted = self.extra is not None or bool(validation and validation["recommended_n_synthetic"])
        trainings: list[tuple[Training, int]] = [("measured + synthetic", 0)]
        if wanted and self.n_synthetic:
            trainings.append(("measured + synthetic + extra", self.n_synthetic))
        return trainings

    def model_type(self, name: str) -> type[FieldModel]:
        """Return the type of a field model by its name."""
        kind: type[FieldModel] = type(self.own_models[name]) if name in self.own_models else FIELD_MODELS[name]
        return kind

    def make_model(self, name: str, repeat: int, preset: Preset = "quick") -> FieldModel:
        """Return a field model that is not fitted."""
        if name in self.own_models:
            return copy(self.own_models[name])
        # validation at random: withheld positions lie among the measured ones, whatever the split of the test
        options = {"preset": preset, "seed": self.seed + repeat, "validation": "random"}
        chosen = model_type(name, preset)
        return chosen(**chosen.supported(options))

    def make_estimator(self, name: str, repeat: int) -> Estimator:
        """Return an estimator that is not trained."""
        if name in self._own_estimators:
            return deepcopy(self._own_estimators[name])
        return make_estimator(name, len(self.train), self.preset, seed=self.seed + repeat)

    @cached_property
    def evaluated(self) -> dict[str, Estimator | type[Estimator]]:
        """Estimators that are evaluated by name, the network first."""
        names = (NETWORKS[self.preset], *(name for name in ESTIMATORS if name not in NETWORKS.values()))
        chosen = names if self.estimators is None else (*self._estimators, STAND_IN)
        return {name: ESTIMATORS[name] for name in names if name in chosen} | self._own_estimators

    @property
    def trainable(self) -> list[str]:
        """Names of the estimators that improve with the number of training spectra, the network first."""
        return [name for name, estimator in self.evaluated.items() if estimator.trainable]

    @cached_property
    def lacking(self) -> dict[str, str]:
        """Reason for each estimator that the test spectra do not suffice for."""
        return {name: reason for name, one in self.evaluated.items() if (reason := one.lacking(self.test))}

    @property
    def candidates(self) -> list[str]:
        """Fast field models that are evaluated, too: all by default, or what the locator needs.

        With "geometry" the room is searched, and matched-field processing locates by it.
        """
        return candidates(self.train) if self.estimators is None else [ROOM_MODEL] * (LOCATOR in self._estimators)

    def is_first(self, name: str) -> bool:
        """Return True for the field model whose spectra stand for turbo learning: the first one, or the chosen one."""
        return self._models[0] in (AUTO, name)

    def finds_room(self, name: str) -> bool:
        """Return True if a field model is built on the room that the spectra show."""
        given = name in self.own_models and getattr(self.own_models[name].config, "scene", None) is not None
        return self.model_type(name).room is not FieldModel.room and not given
