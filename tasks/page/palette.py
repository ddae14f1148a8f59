"""What each method looks like, the same in all figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from swiftwrf.runtime.registry import Entry

# colour-blind safe (P. Tol, "bright"), for names without a colour of their own
OTHERS = ("#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#bbbbbb")


@dataclass(frozen=True)
class Palette:
    """Colours and lines of methods.

    Args:
        colours: `#rrggbb` by name.
        dashed: names whose lines are dashed.
    """

    colours: Mapping[str, str] = field(default_factory=dict)
    dashed: frozenset[str] = frozenset()

    @classmethod
    def of(cls, entries: Iterable[Entry[Any]], dashed: Iterable[str] = ()) -> Palette:
        """The colours of the entries of a registry."""
        return cls({entry.name: entry.colour for entry in entries if entry.colour}, frozenset(dashed))

    def colour(self, name: str) -> str:
        """The colour of that name; one without its own gets one that depends on the name alone."""
        return self.colours.get(name) or OTHERS[sum(name.encode()) % len(OTHERS)]

    def line(self, name: str) -> str:
        """The line style of that name."""
        return "--" if name in self.dashed else "-"
