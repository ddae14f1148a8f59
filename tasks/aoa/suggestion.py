"""Step that suggests positions for the next measurements."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from augment import suggest
from tasks.aoa.condition import MeasuredSubset
from tasks.aoa.context import Experiment
from tasks.run import Row
from tasks.steps import Step


@dataclass(frozen=True)
class Suggestion(Step[Experiment]):
    """Suggest positions for the next measurements.

    Args:
        subset: Measured spectra.
    """

    subset: MeasuredSubset

    title = "choosing positions to measure next"

    @property
    def name(self) -> str:
        return f"suggestion-mix{self.subset.key}"

    def compute(self, experiment: Experiment, folder: Path) -> Row:
        measured, _ = experiment.withhold(self.subset)
        found = suggest(measured, experiment.config.suggest, experiment.config.seed)
        return {"measured": measured.position, "position": found.position, "variance": found.variance}
