"""Pictures of the page: values as PNG, directions of a spectrum and positions on a plan as SVG."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from markupsafe import escape
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from swiftwrf import AngularGrid

Values = NDArray[np.floating]
DISC_PX = 240
MIN_RECTANGLE_PX = 240
PLAN_MARGIN = 0.04  # of the longer side
MIN_PLAN_ASPECT = 0.4  # a path along one axis needs room to drag across it


def data_url(image: Image.Image) -> str:
    """Return an image as a `data:` address, so that it needs no file on the server."""
    stream = io.BytesIO()
    image.save(stream, "PNG", compress_level=1)  # higher levels take twice the time for a tenth of the bytes
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode()


@dataclass(frozen=True, eq=False)
class HemisphereProjection:
    """Projection of the array's hemisphere onto a picture.

    Rectangular: azimuth to the right, elevation upwards. Polar: seen along the array's normal, which is the centre; the
    array's x axis to the right, azimuth counter-clockwise, the array's plane on the rim.

    Args:
        polar: Whether the projection is the polar one.
        width: Width of the picture in pixels.
        height: Height of the picture in pixels.
    """

    polar: bool
    width: int
    height: int
    _nearest: dict[AngularGrid, NDArray[np.integer]] = field(default_factory=dict, repr=False)

    @classmethod
    def rectangular(cls, grid: AngularGrid) -> HemisphereProjection:
        """Return the rectangular projection with a whole number of pixels for each direction of the grid."""
        factor = math.ceil(MIN_RECTANGLE_PX / grid.n_azimuth)
        return cls(False, factor * grid.n_azimuth, factor * grid.n_elevation)

    @classmethod
    def disc(cls) -> HemisphereProjection:
        """Return the polar projection."""
        return cls(True, DISC_PX, DISC_PX)

    def pixel(self, azimuth: float, elevation: float) -> tuple[float, float]:
        """Return x and y of a direction [deg], in pixels from the upper left corner."""
        if not self.polar:
            return azimuth % 360 / 360 * self.width, (1 - elevation / 90) * self.height
        radius, angle = (1 - elevation / 90) * self.width / 2, math.radians(azimuth)
        return self.width / 2 + radius * math.cos(angle), self.height / 2 - radius * math.sin(angle)

    def project(self, spectrum: Values, grid: AngularGrid) -> Values:
        """Return the nearest value of a spectrum (n_elevation, n_azimuth) at every pixel, nan outside the hemisphere."""
        if grid not in self._nearest:
            self._nearest[grid] = self._nearest_direction(grid)
        nearest = self._nearest[grid]
        return np.where(nearest < 0, np.nan, spectrum.ravel()[nearest])

    def _nearest_direction(self, grid: AngularGrid) -> NDArray[np.integer]:
        """Return the flat index of the nearest direction of the grid for every pixel, -1 outside the hemisphere."""
        x, y = (np.arange(self.width) + 0.5) / self.width, 1 - (np.arange(self.height) + 0.5) / self.height
        if self.polar:
            right, up = np.meshgrid(2 * x - 1, 2 * y - 1)
            azimuth, elevation = np.arctan2(up, right) % (2 * np.pi), (1 - np.hypot(right, up)) * np.pi / 2
        else:
            azimuth, elevation = np.meshgrid(x * 2 * np.pi, y * np.pi / 2)
        column = np.round((azimuth - grid.azimuth_start) / grid.azimuth_step).astype(int) % grid.n_azimuth
        row = np.round((elevation - grid.elevation_start) / grid.elevation_step).astype(int)
        return np.where(elevation < 0, -1, row.clip(0, grid.n_elevation - 1) * grid.n_azimuth + column)


@dataclass(frozen=True)
class PlanProjection:
    """Projection of positions onto a plan: x to the right, y upwards, both to the same scale.

    Args:
        low: Lower left corner [m], (2,).
        high: Upper right corner [m], (2,).
        scale: Pixels per metre.
    """

    low: Values
    high: Values
    scale: float

    @classmethod
    def around(cls, *positions: ArrayLike, max_px: tuple[int, int]) -> PlanProjection:
        """Return the plan that contains all finite positions, each (..., 2 or 3) [m].

        Args:
            positions: Arrays of positions.
            max_px: Maximum width and height of the picture.
        """
        xy = np.concatenate([np.asarray(some, dtype=float)[..., :2].reshape(-1, 2) for some in positions])
        xy = xy[np.isfinite(xy).all(axis=1)]
        low, high = xy.min(axis=0), xy.max(axis=0)
        longest = float((high - low).max()) or 1.0
        margin = np.maximum(MIN_PLAN_ASPECT * longest - (high - low), 0) / 2 + PLAN_MARGIN * longest
        low, high = low - margin, high + margin
        return cls(low, high, float((np.array(max_px) / (high - low)).min()))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        width, height = np.rint((self.high - self.low) * self.scale).astype(int).tolist()
        return width, height

    def pixel(self, position: ArrayLike) -> Values:
        """Return pixels (..., 2) from the upper left corner of positions (..., 2 or 3) [m]."""
        xy = np.asarray(position, dtype=float)[..., :2]
        return np.stack([xy[..., 0] - self.low[0], self.high[1] - xy[..., 1]], axis=-1) * self.scale

    def position(self, x: float, y: float) -> tuple[float, float]:
        """Return the position [m] of a pixel, moved into the plan if it lies outside."""
        xy = np.array([self.low[0] + x / self.scale, self.high[1] - y / self.scale])
        east, north = np.clip(xy, self.low, self.high).tolist()
        return east, north

    def contains(self, position: ArrayLike) -> bool:
        """Return True if all positions (..., 2) [m] lie in the plan."""
        xy = np.asarray(position, dtype=float)
        return bool(((self.low <= xy) & (xy <= self.high)).all())

    def axes(self) -> str:
        """Return frame, grid lines and numbers, the numbers outside of the picture."""
        width, height = self.size
        parts = [f'<rect width="{width}" height="{height}" fill="none" stroke="currentColor" stroke-opacity="0.4"/>']
        for axis in (0, 1):
            ticks = MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(self.low[axis], self.high[axis])
            for tick in ticks[(ticks >= self.low[axis]) & (ticks <= self.high[axis])]:
                x, y = self.pixel(np.where(np.arange(2) == axis, tick, self.low))
                path = f"M{x:.1f} 0V{height}" if axis == 0 else f"M0 {y:.1f}H{width}"
                parts.append(f'<path d="{path}" stroke="currentColor" stroke-opacity="0.12"/>')
                number = (x, height + 16, f"{tick:g}", "middle") if axis == 0 else (-6, y + 4, f"{tick:g}", "end")
                parts.append(text(*number))
        return "".join([*parts, text(width, height + 31, "x [m]", "end"), text(-6, -8, "y [m]", "end")])

    def dots(self, position: ArrayLike, colour: str, radius: float) -> str:
        """Return a dot at every position (n, 2 or 3) [m]."""
        steps = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in self.pixel(position))
        return f'<path d="{steps}" stroke="{colour}" stroke-width="{2 * radius}" stroke-linecap="round"/>'

    def line(self, ends: ArrayLike, colour: str = "currentColor", width: float = 2.5, dashed: bool = False) -> str:
        """Return a line between two positions (2, 2 or 3) [m]."""
        (x0, y0), (x1, y1) = self.pixel(ends)
        dashes = ' stroke-dasharray="8 6"' if dashed else ""
        return f'<path d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}" stroke="{colour}" stroke-width="{width}"{dashes}/>'

    def cross(self, position: ArrayLike, colour: str) -> str:
        """Return a cross at one position [m]."""
        x, y = self.pixel(position)
        return cross(x, y, 8, colour)

    def picture(self, image: Image.Image, corners: Sequence[float], opacity: float = 1.0) -> str:
        """Return an image whose corners are x0, x1, y0, y1 [m]."""
        x0, x1, y0, y1 = corners
        (left, top), (right, bottom) = self.pixel([[x0, y1], [x1, y0]])
        box = f'x="{left:.2f}" y="{top:.2f}" width="{right - left:.2f}" height="{bottom - top:.2f}"'
        return f'<image href="{data_url(image)}" {box} preserveAspectRatio="none" opacity="{opacity}"/>'


def text(x: float, y: float, content: str, anchor: str = "start", size: float = 12, haloed: bool = False) -> str:
    """Return an escaped text at a pixel; with a halo it is legible on any colour."""
    place = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size:.4g}"'
    look = 'fill="black" stroke="white" stroke-width="3" paint-order="stroke"' if haloed else 'fill="currentColor"'
    return f"<text {place} {look}>{escape(content)}</text>"


def ring(x: float, y: float, radius: float, colour: str, width: float | None = None) -> str:
    """Return a ring with a dark rim, visible on any colour; the line's width follows the radius by default."""
    return _rimmed(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.2f}" fill="none"', width or radius, colour)


def cross(x: float, y: float, radius: float, colour: str) -> str:
    """Return a diagonal cross with a dark rim."""
    arms = "".join(f"M{x - radius:.1f} {y - s * radius:.1f}L{x + radius:.1f} {y + s * radius:.1f}" for s in (1, -1))
    return _rimmed(f'<path d="{arms}" stroke-linecap="round"', radius, colour)


def _rimmed(shape: str, radius: float, colour: str) -> str:
    strokes = (("black", radius / 1.6), (colour, radius / 3.2))
    return "".join(f'{shape} stroke="{stroke}" stroke-width="{width:.2f}"/>' for stroke, width in strokes)
