"""Data and options that all steps of turbo learning share."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy, deepcopy
from dataclasses import dataclass, field
from functools import cached_property

import torch

from augment.choose import candidates
from augment.cross_validation import STAND_IN, CrossValidationMetrics
from augment.estimators import ESTIMATORS, Estimator, make_estimator
from augment.mix import withhold
from augment.positions import SyntheticPositions
from augment.turbo.condition import NETWORKS, MeasuredSubset
from swiftwrf.choices import AUTO, RAYTRACE
from swiftwrf.data import Spectra
from swiftwrf.errors import InputError
from swiftwrf.metrics import WINDOW
from swiftwrf.models import FIELD_MODELS, FieldModel
from swiftwrf.models.base import model_type
from swiftwrf.runtime.validation import Preset

ROOM_MODEL = "geometry"  # field model that finds the room for all models with one
DEFAULT_EXTRA = 3000  # extra synthetic positions where cross-validation recommends some


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
    models: tuple[str, ...] = (AUTO,)  # field models whose spectra train estimators, or "auto" alone
    estimators: tuple[str, ...] | None = None  # beside kernel regression; None for all, with the network of the preset
    # fast field models that are evaluated, too, None for all whose requirements the data meet; with "geometry" the room is
    # searched, and matched-field processing locates by it
    compared: tuple[str, ...] | None = None
    own_models: Mapping[str, FieldModel] = field(default_factory=dict)  # that are in no registry
    own_estimators: Mapping[str, Estimator] = field(default_factory=dict)  # that are in no registry, and evaluated, too
    extra: int | None = None  # most extra synthetic positions; None for 3,000 where cross-validation recommends some
    preset: Preset = "quick"  # sizes of models and network
    repeats: int = 1  # each with its own measured spectra and seed
    seed: int = 0
    scene: str | None = None  # of the field model `raytrace`
    suggest: int = 0  # number of positions to measure next that are suggested
    device: torch.device | str = "cpu"

    def __post_init__(self) -> None:
        data = self.test
        if len(data) == 0:
            raise InputError(f"this split of {data.name} has no test spectra")
        if min(data.grid.shape) < WINDOW:
            raise InputError(
                f"spectra of {data.name} have {data.grid.shape[0]} x {data.grid.shape[1]} pixels; SSIM, the measure "
                f"of their quality, needs at least {WINDOW} x {WINDOW}"
            )
        for name in self.models:
            missing = [] if name == AUTO else self.model_type(name).lacking(data)
            if missing:
                hint = "give it with --array" if "array" in missing else "the data must contain its position"
                raise InputError(
                    f"synthesizer {name} needs the {missing[0]}, which {data.name} does not describe; {hint}"
                )
        for name in self.estimators or ():
            ESTIMATORS.check(name)
        if self.extra:
            data.direction_at(data.position[:1])  # refuses unknown geometry
        for fraction in self.fractions:
            withhold(self.train, fraction, self.seed)

    @property
    def n_synthetic(self) -> int:
        """Largest number of extra synthetic positions."""
        known = self.test.fixed_position is not None and self.test.rotation is not None
        return self.extra if self.extra is not None else DEFAULT_EXTRA if known else 0

    @property
    def subsets(self) -> list[MeasuredSubset]:
        """Measured subsets of all fractions and repeats."""
        return [MeasuredSubset(fraction, repeat) for repeat in range(self.repeats) for fraction in self.fractions]

    def seed_of(self, subset: MeasuredSubset) -> int:
        """Return the seed of a repeat."""
        return self.seed + subset.repeat

    def withhold(self, subset: MeasuredSubset) -> tuple[Spectra, SyntheticPositions]:
        """Return the measured spectra, and the positions of the others."""
        return withhold(self.train, subset.measured_fraction, self.seed_of(subset))

    def model_type(self, name: str) -> type[FieldModel]:
        """Return the type of a field model by its name."""
        found: type[FieldModel] = type(self.own_models[name]) if name in self.own_models else FIELD_MODELS[name]
        return found

    def make_model(self, name: str, subset: MeasuredSubset, preset: Preset = "quick") -> FieldModel:
        """Return a field model that is not fitted."""
        if name in self.own_models:
            return copy(self.own_models[name])
        # validation at random: withheld positions lie among the measured ones, whatever the split of the test
        options = {"preset": preset, "seed": self.seed_of(subset), "validation": "random", "scene": self.scene}
        chosen = model_type(name, preset)
        return chosen(**chosen.supported(options))

    def make_estimator(self, name: str, subset: MeasuredSubset) -> Estimator:
        """Return an estimator that is not trained."""
        if name in self.own_estimators:
            return deepcopy(self.own_estimators[name])
        return make_estimator(name, len(self.train), self.preset, seed=self.seed_of(subset))

    @cached_property
    def evaluated(self) -> dict[str, Estimator | type[Estimator]]:
        """Estimators that are evaluated by name, the network first."""
        names = (NETWORKS[self.preset], *(name for name in ESTIMATORS if name not in NETWORKS.values()))
        chosen = names if self.estimators is None else (*self.estimators, STAND_IN)
        return {name: ESTIMATORS[name] for name in names if name in chosen} | dict(self.own_estimators)

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
        """Names of the field models that are compared."""
        return candidates(self.train) if self.compared is None else list(self.compared)

    def finds_room(self, name: str) -> bool:
        """Return True if a field model is built on the room that the spectra show."""
        has_room = self.model_type(name).room is not FieldModel.room
        return has_room and not (name == RAYTRACE and self.scene is not None)

    def n_extra(self, validation: CrossValidationMetrics | None) -> int:
        """Return the number of extra synthetic positions of a field model that trains estimators."""
        # by default only where held-out measured spectra gain from extra positions
        wanted = self.extra is not None or bool(validation and validation["recommended_n_synthetic"])
        return self.n_synthetic if wanted else 0
