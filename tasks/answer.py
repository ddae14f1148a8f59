"""The answer of a run, as the terminal, `--json` and the report show it: errors of methods, conclusion, next steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # which imports torch
    from swiftwrf.metrics import ErrorSummary

MAX_USABLE, MAX_REFERENCES = 4, 2  # rows of the short table


@dataclass(frozen=True)
class Method:
    """Errors of one method.

    Args:
        name: Name of the method in all results.
        error: Summary of its errors.
        is_reference: Whether others are measured by it, rather than that a user would take it.
        seconds: Seconds to fit it, and to apply it to the test rows.
        cells: Further cells of its row in the report, by column.
    """

    name: str
    error: ErrorSummary
    is_reference: bool = False
    seconds: tuple[float, ...] = ()
    cells: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class NextStep:
    """Sentence on what to do next, and a line of code to copy, if there is one."""

    text: str
    code: str = ""


@dataclass(frozen=True)
class Answer:
    """The answer of a run.

    Args:
        unit: Unit of the errors.
        methods: Errors of all methods, which are sorted by their medians.
        chosen: Name of the method to take.
        conclusion: Sentences: what the user asked, how sure it is, how it compares.
        next_steps: What to do next.
        shown: Names of the methods that the short table has in any case.

    Example:
        >>> error = {"median": 1.0, "low": 0.5, "high": 2.0, "mean": 1.5, "p90": 3.0, "n": 9}
        >>> answer = Answer("m", [Method("mean", error, is_reference=True), Method("knn", error)], "knn", [], [])
        >>> [[method.name for method in block] for block in answer.short()]
        [['knn'], ['mean']]
    """

    unit: str
    methods: Sequence[Method]
    chosen: str
    conclusion: Sequence[str]
    next_steps: Sequence[NextStep]
    shown: Sequence[str] = ()

    def __post_init__(self) -> None:
        ordered = sorted(self.methods, key=lambda one: (not one.error["n"], one.error["median"]))
        object.__setattr__(self, "methods", ordered)

    def short(self) -> tuple[list[Method], list[Method]]:
        """Return the methods that a user can take and the references of the short table, each sorted."""
        wanted = [self.chosen, *self.shown]
        first = sorted(self.methods, key=lambda one: wanted.index(one.name) if one.name in wanted else len(wanted))
        usable = [one for one in first if not one.is_reference][:MAX_USABLE]
        references = [one for one in first if one.is_reference][:MAX_REFERENCES]
        return [one for one in self.methods if one in usable], [one for one in self.methods if one in references]

    def values(self) -> dict[str, Any]:
        """Return the answer as plain values, for `--json`."""
        unit = self.unit.lower()
        return {
            "rows": [
                {
                    "method": one.name,
                    "chosen": one.name == self.chosen,
                    "reference": one.is_reference,
                    **{key if key == "n" else f"{key}_{unit}": value for key, value in one.error.items()},
                }
                for one in self.methods
            ],
            "conclusion": " ".join(self.conclusion),
            "next_steps": [vars(step) for step in self.next_steps],
        }
