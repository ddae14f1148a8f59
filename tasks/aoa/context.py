"""Data and options that all steps of a run share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch

from augment import SyntheticPositions, withhold
from augment.choose import candidates
from augment.cross_validation import LOCATOR, CrossValidationMetrics
from augment.estimators import ESTIMATORS
from swiftwrf import Spectra
from swiftwrf.models import FIELD_MODELS, FieldModel
from swiftwrf.models.base import model_type
from tasks.aoa.condition import EVERYTHING, Condition, MeasuredSubset, estimators
from tasks.aoa.options import RAYTRACE, AoaConfig
from tasks.run import Preset

ROOM_MODEL = "geometry"  # field model that finds the room for all models with one


@dataclass(frozen=True, eq=False)
class Experiment:
    """Data and options that all steps of a run share.

    Args:
        config: Options of the run.
        train: Training spectra of the split.
        test: Test spectra of the split.
        n_synthetic: Largest number of extra synthetic positions.
        device: Device to compute on.
    """

    config: AoaConfig
    train: Spectra
    test: Spectra
    n_synthetic: int
    device: torch.device

    def seed(self, subset: MeasuredSubset) -> int:
        """Return the seed of a repeat."""
        return self.config.seed + subset.repeat

    def withhold(self, subset: MeasuredSubset) -> tuple[Spectra, SyntheticPositions]:
        """Return the measured spectra without their snapshots, and the positions of the others."""
        measured, withheld = withhold(self.train, subset.measured_fraction, self.seed(subset))
        return replace(measured, channel=None), withheld  # snapshots train nothing, and every subset would copy them

    def with_snapshots(self, measured: Spectra) -> Spectra:
        """Return measured spectra with their snapshots, if the data contain them."""
        return self.train.subset((self.train.index == measured.index[:, None]).nonzero()[:, 1])

    def make_model(self, name: str, subset: MeasuredSubset, preset: Preset = "quick") -> FieldModel:
        """Return a field model that is not fitted."""
        # validation at random: withheld positions lie among the measured ones, whatever the split of the test
        options = {"preset": preset, "seed": self.seed(subset), "validation": "random", "scene": self.config.scene}
        chosen = model_type(name, preset)
        return chosen(**chosen.supported(options))

    @property
    def candidates(self) -> list[str]:
        """Names of the field models that are compared."""
        return candidates(self.train)

    def finds_room(self, name: str) -> bool:
        """Return True if a field model is built on the room that the spectra show."""
        has_room = FIELD_MODELS[name].room is not FieldModel.room
        return has_room and not (name == RAYTRACE and self.config.scene is not None)

    def n_extra(self, validation: CrossValidationMetrics | None) -> int:
        """Return the number of extra synthetic positions of a field model that trains estimators."""
        # by default only where held-out measured spectra gain from extra positions
        wanted = self.config.extra is not None or bool(validation and validation["recommended_n_synthetic"])
        return self.n_synthetic if wanted else 0

    @cached_property
    def lacking(self) -> dict[str, str]:
        """Reason for each estimator that the test spectra do not suffice for."""
        names = estimators(self.config.preset)
        return {name: reason for name in names if (reason := ESTIMATORS[name].lacking(self.test))}

    def located_by(self, subset: MeasuredSubset) -> tuple[Condition, ...]:
        """Return the conditions of matched-field processing that use the room found in these measured spectra."""
        found = []
        if subset.measured_fraction in self.config.mix:
            found.append(
                Condition(LOCATOR, "measured", measured_fraction=subset.measured_fraction, repeat=subset.repeat)
            )
        if subset == EVERYTHING:
            found += [
                Condition(LOCATOR, "all", measured_fraction=fraction, repeat=repeat)
                for repeat in range(self.config.repeats)
                for fraction in self.config.mix
            ]
        return tuple(found)
