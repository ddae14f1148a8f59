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
    """Errors of one method."""

    name: str  # name of the method in all results
    error: ErrorSummary  # summary of its errors
    is_reference: bool = False  # whether others are measured by it, rather than that a user would take it
    seconds: tuple[float, ...] = ()  # seconds to fit it, and to apply it to the test rows
    cells: Mapping[str, str] = field(default_factory=dict)  # further cells of its row in the report, by column


@dataclass(frozen=True)
class NextStep:
    """Sentence on what to do next, and a line of code to copy, if there is one."""

    text: str
    code: str = ""


@dataclass(frozen=True)
class Answer:
    """The answer of a run.

    Example:
        >>> error = {"median": 1.0, "low": 0.5, "high": 2.0, "mean": 1.5, "p90": 3.0, "n": 9}
        >>> answer = Answer("m", [Method("mean", error, is_reference=True), Method("knn", error)], "knn", [], [])
        >>> [[method.name for method in block] for block in answer.short()]
        [['knn'], ['mean']]
    """

    unit: str  # unit of the errors
    methods: Sequence[Method]  # errors of all methods, which are sorted by their medians
    chosen: str  # name of the method to take
    conclusion: Sequence[str]  # sentences: what the user asked, how sure it is, how it compares
    next_steps: Sequence[NextStep]  # what to do next
    shown: Sequence[str] = ()  # names of the methods that the short table has in any case

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
