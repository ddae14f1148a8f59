"""A computation cut into steps that follow from each other, so that results can be kept and computed in any process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

STEPS = "steps"  # folder, beside the results, of the files that only later steps read

Context = TypeVar("Context")
"""data and configuration that all steps share"""


class Step(ABC, Generic[Context]):
    """One computation of a run. Its fields are small, because it is sent to workers and read from results.

    Large data are in the context, and in files of one folder, which all workers share.
    """

    @property
    @abstractmethod
    def name(self) -> str:
        """Key of the kept result. Steps with one name are one step."""

    @property
    def title(self) -> str:
        """Description of the step for the terminal."""
        return self.name

    @abstractmethod
    def compute(self, context: Context, folder: Path) -> dict[str, Any]:
        """Return plain values. Files are read and written in `folder`."""

    @property
    def priority(self) -> int:
        """Priority among the steps that could begin: 2 if other steps wait for this one, 1 if it takes long, else 0."""
        return 2 if type(self).then is not Step.then else 0

    def then(self, context: Context, value: dict[str, Any]) -> Sequence[Step[Context]]:
        """Return the steps that follow from the result."""
        return ()


def walk(
    steps: Iterable[Step[Context]], context: Context, compute: Callable[[Step[Context]], dict[str, Any]]
) -> Iterator[tuple[Step[Context], dict[str, Any]]]:
    """Yield each step with its computed result, followed by the steps that follow from it.

    Steps with one name have one result.
    """
    for step in steps:
        value = compute(step)
        yield step, value
        yield from walk(step.then(context, value), context, compute)
