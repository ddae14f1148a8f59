"""Colours of methods, equal in all figures, and line styles that distinguish the curves of a panel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tasks.labels import OTHER_COLOURS, Label

DASHES: tuple[Any, ...] = ("-", (0, (6, 2)), (0, (2, 1.5)), (0, (7, 2, 1.5, 2)))
"""Line styles of the curves of one panel, in their order."""
MAX_CURVES = len(DASHES)  # of one panel


@dataclass(frozen=True)
class Palette:
    """Colours of methods.

    Args:
        colours: Colours `#rrggbb` by name.

    Example:
        >>> Palette({"gp": "#d1620f"}).colour("gp")
        '#d1620f'
    """

    colours: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, labels: Mapping[str, Label]) -> Palette:
        """Return the palette of labelled methods."""
        return cls({name: label.colour for name, label in labels.items() if label.colour})

    def colour(self, name: str) -> str:
        """Return the colour of a method. A method without a label has a colour that follows from its name."""
        return self.colours.get(name) or OTHER_COLOURS[sum(name.encode()) % len(OTHER_COLOURS)]
