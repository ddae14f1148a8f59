"""Findings: sentences and numbers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

Level = Literal["fact", "warning"]


@dataclass(frozen=True)
class Finding:
    """One sentence: a fact or a warning."""

    level: Level
    text: str


@dataclass
class Findings:
    """Sentences and numbers, in the order of the checks."""

    sentences: list[Finding] = field(default_factory=list)
    numbers: dict[str, Any] = field(default_factory=dict)

    def add(self, text: str, **numbers: Any) -> None:
        """Add a fact."""
        self.sentences.append(Finding("fact", text))
        self.numbers |= numbers

    def warn(self, text: str, **numbers: Any) -> None:
        """Add a warning."""
        self.sentences.append(Finding("warning", text))
        self.numbers |= numbers
