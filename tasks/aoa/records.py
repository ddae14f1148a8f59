"""One measured fraction of one run, as the report shows it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from pandas import DataFrame

from augment.choices import AUTO, fraction_key
from augment.turbo.condition import Condition, Row, conditions_of, headline
from tasks import labels
from tasks.records import Records

# colours of conditions without a field model
LOWER_REFERENCE, UPPER_REFERENCE, CHOSEN = "#cf4a4a", "#2a9165", "#3a7fd5"


@dataclass(frozen=True)
class FractionRecords:
    """One measured fraction, by its key in metrics.json and in file names, of one run."""

    run: Records
    key: str

    @classmethod
    def of(cls, run: Records) -> list[FractionRecords]:
        """Return all measured fractions of a run."""
        return [cls(run, key) for key in run.metrics["mixes"]]

    @cached_property
    def mix(self) -> Row:
        """Metrics of the measured fraction."""
        found: Row = self.run.metrics["mixes"][self.key]
        return found

    @cached_property
    def conditions(self) -> dict[str, Condition]:
        """Condition of each method."""
        return conditions_of(self.mix["methods"])

    @property
    def medians(self) -> dict[str, float]:
        """Median angular error [deg] of each method."""
        return {name: method["great_circle_deg"]["median"] for name, method in self.mix["methods"].items()}

    @property
    def turbo_method(self) -> str:
        """Method of the network, or of kernel regression without one, with all spectra of the first field model."""
        return headline(self.conditions.values()).method

    @property
    def chosen(self) -> str:
        """Method that cross-validation chose, or `turbo_method` without a choice."""
        choice = self.mix["estimator_choice"]
        return choice["name"] if choice else self.turbo_method

    def table(self, name: str) -> DataFrame:
        """Return the rows of a table of the run, e.g. `errors`, with this measured fraction."""
        table = self.run.table(name)
        return table[[fraction_key(float(text)) == self.key for text in table["measured_fraction"]]]

    def arrays(self, kind: str) -> dict[str, NDArray[Any]]:
        """Return the arrays of one kind, e.g. `located`, that the run left; none if it left no such file."""
        return self.run.arrays(f"{kind}-mix{self.key}")

    def synthesizers(self, methods: Iterable[str]) -> list[str]:
        """Return the field models behind these methods, that of the first repeat where repeats chose differently."""
        found = dict.fromkeys(self.conditions[name].synthesizer for name in methods if name in self.conditions)
        choice = self.mix["choice"]
        return [name for name in found if name not in ("", AUTO)] or ([choice["name"]] if choice else [])

    @property
    def chosen_file(self) -> Path | None:
        """File of the estimator that held-out spectra chose. None if nothing was chosen, or what has no file."""
        choice = self.mix["estimator_choice"]
        name = choice.get("file") if choice else None
        return self.run.folder / name if name else None

    @property
    def percent(self) -> str:
        """The measured fraction in percent."""
        return f"{float(self.key):.0%}"

    @property
    def file_name(self) -> str:
        """Last part of the names of its figures."""
        return f"mix{self.key}-{self.run.file_name}"

    @property
    def scene(self) -> str:
        """Name among the measured fractions of a report."""
        return f"{self.percent} measured, {self.run.scene}"

    @property
    def palette(self) -> dict[str, str]:
        """Colours of its field models and conditions."""
        return palette(self.conditions.values())


def palette(conditions: Iterable[Condition]) -> dict[str, str]:
    """Return colours of all field models and of these conditions.

    Conditions of one field model have its colour.
    """
    found = models = labels.colours(labels.FIELD_MODELS)
    for condition in conditions:
        match condition.training:
            case "measured" if condition.is_network:
                own = LOWER_REFERENCE
            case "measured":
                own = labels.colour(labels.ESTIMATORS, condition.estimator)
            case "all measured":
                own = UPPER_REFERENCE
            case _:
                own = CHOSEN if condition.synthesizer == AUTO else labels.colour(models, condition.synthesizer)
        found = found | {condition.method: own}
    return found
