"""Colours and line styles of methods, the same in all figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from tasks.labels import OTHER_COLOURS, Label


@dataclass(frozen=True)
class Palette:
    """Colours and line styles of methods.

    Args:
        colours: Colours `#rrggbb` by name.
        dashed: Names whose lines are dashed.

    Example:
        >>> Palette({"gp": "#ee8866"}, frozenset({"peak"})).line("peak")
        '--'
    """

    colours: Mapping[str, str] = field(default_factory=dict)
    dashed: frozenset[str] = frozenset()

    @classmethod
    def of(cls, labels: Mapping[str, Label], dashed: Iterable[str] = ()) -> Palette:
        """Return the palette of labelled methods."""
        return cls({name: label.colour for name, label in labels.items() if label.colour}, frozenset(dashed))

    def colour(self, name: str) -> str:
        """Return the colour of a method. A method without a label has a colour that follows from its name."""
        return self.colours.get(name) or OTHER_COLOURS[sum(name.encode()) % len(OTHER_COLOURS)]

    def line(self, name: str) -> str:
        """Return the line style of a method."""
        return "--" if name in self.dashed else "-"
