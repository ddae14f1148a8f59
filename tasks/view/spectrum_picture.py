"""One spectrum on the page, with its axes and the directions marked in it."""

from __future__ import annotations

import numpy as np
from nicegui import ui
from numpy.typing import NDArray

from swiftwrf import AngularGrid
from tasks.view.pictures import View, address, png
from tasks.view.plan import cross, ring, text
from tasks.view.spectra import Direction


class SpectrumPicture:
    """One spectrum with its directions, in the view that is chosen.

    Args:
        title: what it shows.
        name: of its element on the page.
        colours: of its values.
    """

    def __init__(self, title: str, name: str, colours: str = "viridis") -> None:
        self._colours = colours
        with ui.column().classes("gap-0") as self.column:
            ui.label(title).classes("text-weight-medium")
            self.caption = ui.label().classes("quiet numbers")
            self._picture = ui.interactive_image(sanitize=False).classes("outside pixels").props(f'id="{name}"')
        self._view: View | None = None

    def lay_out(self, view: View) -> None:
        """Takes the view, and gives it its room on the page."""
        self._view = view
        self.column.style(f"width: {_width(view) + 100}px")
        self._picture.style(
            f"width: {_width(view)}px; margin: {'24px 50px 28px 50px' if view.polar else '6px 24px 24px 40px'}"
        )
        self._picture._props["size"] = (view.width, view.height)

    def show(
        self, values: NDArray[np.floating], grid: AngularGrid, high: float, marks: list[tuple[Direction | None, str]]
    ) -> None:
        """Values (n_elevation, n_azimuth) and the directions marked in them, each with its colour: the first a ring, the
        second a cross."""
        assert self._view is not None
        drawn = png(self._view.lay(values, grid), self._colours, 0.0, high)
        self._picture.set_source(address(drawn))
        unit = self._view.width / _width(self._view)  # of this picture, a pixel of the page
        shapes = [_axes(self._view, unit)]
        for (direction, colour), shape in zip(marks, (ring, cross), strict=False):
            if direction is not None:
                shapes.append(shape(*self._view.place(*direction), 7 * unit, colour))
        self._picture.set_content("".join(shapes))


def _width(view: View) -> int:
    """Of a picture on the page [px]."""
    return 290 if view.polar else 750


def _axes(view: View, unit: float) -> str:
    """Numbers around the picture [deg]."""
    size = 12 * unit
    if not view.polar:
        below, beside = view.height + 15 * unit, -6 * unit
        parts = [text(a / 360 * view.width, below, f"{a}°", "middle", size) for a in (0, 90, 180, 270, 360)]
        parts += [text(beside, view.place(0, e)[1] + 4 * unit, f"{e}°", "end", size) for e in (0, 30, 60, 90)]
        return "".join(parts)
    parts = []
    middle = view.width / 2
    for elevation in (0, 30, 60):
        radius = (1 - elevation / 90) * middle
        circle = f'<circle cx="{middle}" cy="{middle}" r="{radius:.1f}" fill="none" stroke-width="{unit:.2f}"'
        parts.append(f'{circle} stroke="{"currentColor" if elevation == 0 else "white"}" stroke-opacity="0.5"/>')
    for azimuth, anchor in ((0, "start"), (90, "middle"), (180, "end"), (270, "middle")):
        x, y = view.place(azimuth, -4)
        parts.append(
            text(
                x, y + (12 * unit if azimuth == 270 else 4 * unit if azimuth != 90 else 0), f"{azimuth}°", anchor, size
            )
        )
    return "".join(parts)
