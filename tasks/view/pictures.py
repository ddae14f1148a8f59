"""From values to the bytes of a picture: colours, views of a spectrum, places in them."""

from __future__ import annotations

import base64
import io
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from PIL import Image

from swiftwrf import AngularGrid

Values = NDArray[np.floating]
CLEAR = 255  # the colour of what is not drawn; all others show values
DISC = 240  # pixels across a polar view
QUICK = 1  # level of compression: the next ones take twice the time for a tenth of the bytes


def png(values: Values, colours: str, low: float = 0.0, high: float = 1.0) -> bytes:
    """A picture of values (rows, columns), the first row on top; nan is transparent.

    Args:
        values: of the pixels.
        colours: name of a colour map.
        low, high: values of its ends.
    """
    scaled = (values - low) * (CLEAR - 1) / (high - low)
    index = np.where(np.isnan(values), CLEAR, np.clip(scaled, 0, CLEAR - 1)).astype(np.uint8)
    image = Image.fromarray(index).convert("L")
    image.putpalette(_palette(colours))
    stream = io.BytesIO()
    image.save(stream, "PNG", compress_level=QUICK, transparency=CLEAR)
    return stream.getvalue()


def as_png(pixels: NDArray[np.uint8]) -> bytes:
    """An image (rows, columns, 3)."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG", compress_level=QUICK)
    return stream.getvalue()


def _palette(colours: str) -> bytes:
    rgb = colormaps[colours](np.linspace(0, 1, CLEAR), bytes=True)[:, :3]
    return bytes(rgb.tobytes()) + b"\0\0\0"


def address(content: bytes) -> str:
    """A data address of a PNG picture: it travels with the page's other changes and needs no file."""
    return "data:image/png;base64," + base64.b64encode(content).decode()


@dataclass(frozen=True)
class View:
    """A way to lay the directions of a hemisphere on a plane.

    Rectangular: azimuth to the right, elevation upwards. Polar: seen along the array's normal, which is the centre; the
    array's x axis to the right, azimuth counter-clockwise, the array's plane the rim.

    Args:
        polar: which of the two.
        width, height: of the picture in pixels.
    """

    polar: bool
    width: int
    height: int

    @classmethod
    def rectangular(cls, grid: AngularGrid) -> View:
        """One pixel a direction of the grid; at least so many that texts beside it are drawn finely."""
        factor = max(1, math.ceil(240 / grid.n_azimuth))
        return cls(False, factor * grid.n_azimuth, factor * grid.n_elevation)

    @classmethod
    def disc(cls) -> View:
        """The polar view."""
        return cls(True, DISC, DISC)

    def place(self, azimuth: float, elevation: float) -> tuple[float, float]:
        """Where a direction [deg] lies in the picture, pixels from its upper left corner."""
        if not self.polar:
            return azimuth % 360 / 360 * self.width, (1 - elevation / 90) * self.height
        radius, turn = (1 - elevation / 90) * self.width / 2, math.radians(azimuth)
        return self.width / 2 + radius * math.cos(turn), self.height / 2 - radius * math.sin(turn)

    @cached_property
    def _direction(self) -> tuple[Values, Values]:
        """Azimuth and elevation [rad] of every pixel; elevations below 0 are outside."""
        x, y = np.arange(self.width) + 0.5, self.height - np.arange(self.height) - 0.5
        if not self.polar:
            azimuth, elevation = np.meshgrid(x / self.width * 2 * np.pi, y / self.height * np.pi / 2)
            return azimuth, elevation
        right, up = np.meshgrid(2 * x / self.width - 1, 2 * y / self.height - 1)
        return np.arctan2(up, right) % (2 * np.pi), (1 - np.hypot(right, up)) * np.pi / 2

    def lay(self, spectrum: Values, grid: AngularGrid) -> Values:
        """The nearest value of a spectrum (n_elevation, n_azimuth) at every pixel, nan outside."""
        return np.where(self._direction[1] < 0, np.nan, spectrum.ravel()[self._nearest(grid)])

    def _nearest(self, grid: AngularGrid) -> NDArray[np.integer]:
        """Flat index of the direction of the grid that is nearest to each pixel."""
        if grid not in self._kept:
            azimuth, elevation = self._direction
            column = np.round((azimuth - grid.azimuth_start) / grid.azimuth_step).astype(int) % grid.n_azimuth
            row = np.round((elevation - grid.elevation_start) / grid.elevation_step).astype(int)
            self._kept[grid] = row.clip(0, grid.n_elevation - 1) * grid.n_azimuth + column
        return self._kept[grid]

    @cached_property
    def _kept(self) -> dict[AngularGrid, NDArray[np.integer]]:
        return {}
