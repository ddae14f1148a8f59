"""A plan: positions in metres as places in a picture, and what is drawn there as SVG."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import escape
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

EDGE = 0.04  # of the extent, beyond what is shown
NARROWEST = 0.4  # of a plan, over its longer side: a path along an axis, too, leaves room to drag


@dataclass(frozen=True)
class Plan:
    """What is seen from above: x to the right, y upwards, both to the same scale.

    Args:
        low, high: corners [m], (2,).
        scale: pixels a metre.
    """

    low: NDArray[np.floating]
    high: NDArray[np.floating]
    scale: float

    @classmethod
    def around(cls, *places: ArrayLike, most: tuple[int, int]) -> Plan:
        """The plan that shows all these positions, each (..., 2 or 3) [m], in at most so many pixels to the right and
        upwards; what is not finite is left out."""
        at = np.concatenate([np.asarray(place, dtype=float)[..., :2].reshape(-1, 2) for place in places])
        at = at[np.isfinite(at).all(axis=1)]
        low, high = at.min(axis=0), at.max(axis=0)
        longest = float((high - low).max()) or 1.0
        short = np.maximum(NARROWEST * longest - (high - low), 0) / 2
        edge = short + EDGE * longest
        low, high = low - edge, high + edge
        return cls(low, high, float((np.array(most) / (high - low)).min()))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        width, height = np.rint((self.high - self.low) * self.scale).astype(int).tolist()
        return width, height

    def place(self, at: ArrayLike) -> NDArray[np.floating]:
        """Pixels from the upper left corner (..., 2) of positions (..., 2 or 3) [m]."""
        at = np.asarray(at, dtype=float)[..., :2]
        return np.stack([at[..., 0] - self.low[0], self.high[1] - at[..., 1]], axis=-1) * self.scale

    def position(self, x: float, y: float) -> tuple[float, float]:
        """The position [m] at a pixel, kept inside the plan."""
        at = np.array([self.low[0] + x / self.scale, self.high[1] - y / self.scale])
        east, north = np.clip(at, self.low, self.high).tolist()
        return east, north

    def shows(self, at: ArrayLike) -> bool:
        """Whether all of these positions (..., 2) [m] lie in the plan."""
        at = np.asarray(at, dtype=float)
        return bool(((self.low <= at) & (at <= self.high)).all())

    def axes(self) -> str:
        """Frame, ticks and their numbers, outside of the picture."""
        width, height = self.size
        parts = [f'<rect width="{width}" height="{height}" fill="none" stroke="currentColor" stroke-opacity="0.4"/>']
        for axis in (0, 1):
            ticks = MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(self.low[axis], self.high[axis])
            for tick in ticks[(ticks >= self.low[axis]) & (ticks <= self.high[axis])]:
                at = np.where(np.arange(2) == axis, tick, self.low)
                x, y = self.place(at)
                if axis == 0:
                    parts += [_line(x, 0, x, height), text(x, height + 16, f"{tick:g}", "middle")]
                else:
                    parts += [_line(0, y, width, y), text(-6, y + 4, f"{tick:g}", "end")]
        parts.append(text(width, height + 31, "x [m]", "end"))
        parts.append(text(-6, -8, "y [m]", "end"))
        return "".join(parts)

    def dots(self, at: ArrayLike, colour: str, radius: float) -> str:
        """A dot at every position (n, 2 or 3) [m]."""
        steps = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in self.place(at))
        return f'<path d="{steps}" stroke="{colour}" stroke-width="{2 * radius}" stroke-linecap="round"/>'

    def line(self, ends: ArrayLike, certain: bool = True) -> str:
        """A wall between two positions [m], dashed where it is uncertain."""
        (x0, y0), (x1, y1) = self.place(ends)
        dashes = "" if certain else ' stroke-dasharray="8 6"'
        return f'<path d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" stroke="currentColor" stroke-width="2.5"{dashes}/>'

    def cross(self, at: ArrayLike, colour: str) -> str:
        """A cross at one position [m]."""
        x, y = self.place(at)
        return cross(x, y, 8, colour)

    def picture(self, source: str, corners: Sequence[float], opacity: float = 1.0) -> str:
        """A picture whose corners are x0, x1, y0, y1 [m]."""
        x0, x1, y0, y1 = corners
        (left, top), (right, bottom) = self.place([[x0, y1], [x1, y0]])
        box = f'x="{left:.2f}" y="{top:.2f}" width="{right - left:.2f}" height="{bottom - top:.2f}"'
        return f'<image href="{source}" {box} preserveAspectRatio="none" opacity="{opacity}"/>'


def _line(x0: float, y0: float, x1: float, y1: float) -> str:
    return f'<path d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" stroke="currentColor" stroke-opacity="0.12"/>'


def text(x: float, y: float, content: str, anchor: str = "start", size: float = 12, haloed: bool = False) -> str:
    """A text at a pixel, whatever is in it; with a halo it can be read on any colour."""
    place = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size:.4g}"'
    look = 'fill="black" stroke="white" stroke-width="3" paint-order="stroke"' if haloed else 'fill="currentColor"'
    return f"<text {place} {look}>{escape(content)}</text>"


def ring(x: float, y: float, radius: float, colour: str) -> str:
    """A ring with a dark rim, to be seen on any colour."""
    circle = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.2f}" fill="none"'
    return "".join(
        f'{circle} stroke="{stroke}" stroke-width="{width:.2f}"/>' for stroke, width in _strokes(radius, colour)
    )


def cross(x: float, y: float, radius: float, colour: str) -> str:
    """A diagonal cross with a dark rim."""
    arms = "".join(f"M{x - radius:.1f} {y - s * radius:.1f}L{x + radius:.1f} {y + s * radius:.1f}" for s in (1, -1))
    path = f'<path d="{arms}" stroke-linecap="round"'
    return "".join(
        f'{path} stroke="{stroke}" stroke-width="{width:.2f}"/>' for stroke, width in _strokes(radius, colour)
    )


def _strokes(radius: float, colour: str) -> tuple[tuple[str, float], ...]:
    """Colours and widths of a rim and of what is on it."""
    return ("black", radius / 1.6), (colour, radius / 3.2)
