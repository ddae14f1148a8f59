"""Step of the experiment: an estimator is trained on one training set and tested."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from augment import Mixed, mix
from tasks.aoa.condition import MEASURED_STAND_IN, STAND_IN, Condition, MeasuredSubset
from tasks.aoa.context import Experiment
from tasks.aoa.estimators import SavedEstimator, make_estimator
from tasks.aoa.options import AUTO
from tasks.run import Row
from tasks.steps import Step

if TYPE_CHECKING:
    from tasks.aoa.synthesis import Synthesis


@dataclass(frozen=True)
class Evaluation(Step[Experiment]):
    """Train and test one condition.

    Args:
        condition: Estimator and training set.
        synthesis: Step of the synthetic spectra, if there are any.
    """

    condition: Condition
    synthesis: Synthesis | None = None

    @property
    def subset(self) -> MeasuredSubset:
        """Measured spectra of the condition."""
        return self.condition.subset

    @property
    def name(self) -> str:
        return self.condition.result_name

    @property
    def title(self) -> str:
        return f"training {self.condition.estimator}, {self.condition.meaning}"

    @property
    def reads(self) -> tuple[str, ...]:
        return (self.synthesis.file,) if self.synthesis else ()

    @property
    def priority(self) -> int:
        return int(self.condition.is_network)

    @property
    def is_optional(self) -> bool:
        return self.condition.is_network

    def compute(self, experiment: Experiment, folder: Path) -> Row:
        train = self._training_set(experiment, folder)
        config, name = experiment.config, self.condition.estimator
        estimator = make_estimator(name, len(experiment.train), config.preset, seed=experiment.seed(self.subset))
        began = time.perf_counter()
        estimator.fit(train, device=experiment.device)
        fitted = time.perf_counter()
        estimate = estimator.estimate(experiment.test)
        if isinstance(estimator, SavedEstimator) and (file := self._saved_as(experiment)):
            estimator.save(folder / f"{file}-mix{self.subset.key}.safetensors")
        seconds = {"train": fitted - began, "estimate": time.perf_counter() - fitted}
        return {"estimate": estimate, "seconds": seconds, "history": estimator.history, "counts": train.counts}

    def _saved_as(self, experiment: Experiment) -> str:
        """Return the file name of a condition that a user may choose, empty for the others.

        These have all spectra of the first field model, or are the measured-only candidate of the cross-validation.
        """
        if self.subset.repeat:
            return ""
        if self.synthesis is None:
            return MEASURED_STAND_IN if self.condition.method == STAND_IN else ""
        first = experiment.config.synthesizer[0] in (AUTO, self.synthesis.synthesizer)
        is_complete = self.condition.n_synthetic == self.synthesis.n_synthetic
        return self.condition.estimator if first and is_complete else ""

    def _training_set(self, experiment: Experiment, folder: Path) -> Mixed:
        if self.condition.training == "all":
            return Mixed.measured(experiment.train)
        measured, _ = experiment.withhold(self.subset)
        if self.synthesis is None:
            return Mixed.measured(measured)
        train = mix(measured, *self.synthesis.training_spectra(folder, "withheld"))
        if self.condition.training == "turbo_extra":
            train = train.add(*self.synthesis.training_spectra(folder, "extra"))
        return train
