"""Figures and tables of objects in notebooks. matplotlib is imported when a figure is made."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf.array.angles import AngularGrid

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
else:
    Axes = Any

MARK = "#cc3311"  # of a true or estimated value in a figure, distinct from all colours of viridis
HATCH = "#555b66"


class Displayed:
    """Base class of objects that notebooks show as a table. A subclass implements `_facts`.

    Example:
        >>> class Room(Displayed):
        ...     def _facts(self):
        ...         return {"walls": "4"}
        >>> Room()._repr_html_()
        '<table><caption>Room</caption><tr><th>walls</th><td>4</td></tr></table>'
    """

    def _facts(self) -> Mapping[str, str]:
        """Return what the table contains, by name."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        rows = (f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in self._facts().items())
        return f"<table><caption>{escape(type(self).__name__)}</caption>{''.join(rows)}</table>"


def extent(position: Tensor) -> str:
    """Return the sides of the box around positions (n, 3) [m] in words.

    Example:
        >>> import torch
        >>> extent(torch.tensor([[0.0, 0.0, 1.0], [5.0, 4.0, 1.0]]))
        '5.00 x 4.00 x 0.00 m'
    """
    sides = (position.amax(dim=0) - position.amin(dim=0)).tolist() if len(position) else [0.0] * 3
    return f"{' x '.join(f'{side:.2f}' for side in sides)} m"


def polar_spectrum(
    spectrum: Tensor,
    grid: AngularGrid,
    ax: Axes | None = None,
    colours: str = "viridis",
    limits: tuple[float, float] = (0.0, 1.0),
    label: str | None = "magnitude",
) -> Axes:
    """Draw a spectrum as seen along the normal of the array, which is the centre, and return the axes.

    Args:
        spectrum: Values, e.g. magnitudes in [0, 1], (n_elevation, n_azimuth).
        grid: Directions of the pixels.
        ax: Polar axes to draw into. Defaults to those of a new figure.
        colours: Name of a matplotlib colour map.
        limits: Values of the first and the last colour.
        label: Label of the colour bar. None for no colour bar.

    Example:
        >>> import torch
        >>> polar_spectrum(torch.rand(9, 36), AngularGrid.hemisphere(9, 36)).name
        'polar'
    """
    if ax is None:
        from matplotlib import pyplot

        ax = pyplot.figure().add_subplot(projection="polar")
    azimuth = np.degrees(grid.azimuth_start + grid.azimuth_step * (np.arange(grid.n_azimuth + 1) - 0.5))
    elevation = np.degrees(grid.elevation_start + grid.elevation_step * (np.arange(grid.n_elevation + 1) - 0.5))
    if grid.n_elevation == 1:
        elevation = np.array([0.0, 30.0])  # a ring is wide enough to be seen
    zenith = (90 - elevation).clip(0, 90)
    low, high = limits
    mesh = ax.pcolormesh(
        np.radians(azimuth), zenith, _array(spectrum), rasterized=True, cmap=colours, vmin=low, vmax=high
    )
    ax.set(ylim=(0, 90), yticks=(30, 60, 90), yticklabels=("60°", "30°", "0°"))  # elevations
    ax.grid(alpha=0.4)
    if label is not None:
        ax.figure.colorbar(mesh, ax=ax, label=label, pad=0.1)
    return ax


def mark_direction(ax: Axes, azimuth: float, elevation: float, label: str) -> None:
    """Mark a direction [rad] in the figure of `polar_spectrum`."""
    ax.plot(azimuth, 90 - np.degrees(elevation), "o", markersize=11, fillstyle="none", color=MARK, label=label)
    ax.legend(loc="lower left", bbox_to_anchor=(-0.15, -0.12))


def plan(position: Tensor, value: Tensor, label: str, ax: Axes | None = None, **style: Any) -> Axes:
    """Draw values at positions, seen from above and to scale, and return the axes. Values that are nan are left out.

    Args:
        position: (n, 3) [m].
        value: (n,).
        label: Quantity and unit of the values.
        ax: Axes to draw into. Defaults to those of a new figure.
        style: Arguments of `Axes.scatter`.

    Example:
        >>> import torch
        >>> plan(torch.rand(5, 3), torch.rand(5), "RSSI [dBm]").get_xlabel()
        'x [m]'
    """
    ax = plan_axes(ax)
    x, y, _ = _array(position).T
    points = ax.scatter(x, y, c=_array(value), **({"s": 14} | style))
    ax.figure.colorbar(points, ax=ax, label=label)
    return ax


def corners_of(x: NDArray[Any], y: NDArray[Any], cell: float | None = None) -> tuple[float, float, float, float]:
    """Return the edges x0, x1, y0, y1 of a map from the centres of its columns and rows.

    Args:
        x: Centres of the columns, ascending.
        y: Centres of the rows, ascending.
        cell: Edge of a cell. Defaults to the distance of the centres. Then a single row is as high as a column is wide.

    Example:
        >>> corners_of(np.array([0.0, 2.0]), np.array([5.0]))
        (-1.0, 3.0, 4.0, 6.0)
    """
    steps = [float(line[1] - line[0]) for line in (x, y) if len(line) > 1] if cell is None else [cell]
    dx, dy = (steps[end] / 2 if steps else 0.5 for end in (0, -1))
    return float(x[0]) - dx, float(x[-1]) + dx, float(y[0]) - dy, float(y[-1]) + dy


def plan_map(
    corners: tuple[float, float, float, float], value: NDArray[Any], label: str, ax: Axes | None = None
) -> Axes:
    """Draw a map seen from above and to scale, and return the axes.

    Args:
        corners: Edges x0, x1, y0, y1 [m].
        value: Values of the cells, (rows along y, columns along x).
        label: Quantity and unit of the values.
        ax: Axes to draw into. Defaults to those of a new figure.

    Example:
        >>> plan_map((0, 4, 0, 2), np.zeros((2, 4)), "RSSI [dBm]").get_ylabel()
        'y [m]'
    """
    ax = plan_axes(ax)
    image = ax.imshow(value, origin="lower", extent=corners)
    ax.figure.colorbar(image, ax=ax, label=label)
    return ax


def hatch(ax: Axes, x: NDArray[Any], y: NDArray[Any], where: NDArray[np.bool_], pattern: str = "////") -> None:
    """Hatch cells of a map with centres x (columns,) and y (rows,) [m] where a mask (rows, columns) is true."""
    if not where.any():
        return
    mask, (x0, x1, y0, y1) = np.pad(where, 1, mode="edge").astype(float), corners_of(x, y)
    x, y = np.concatenate([[x0], x, [x1]]), np.concatenate([[y0], y, [y1]])
    with np.errstate(all="ignore"):
        drawn = ax.contourf(x, y, mask, levels=[0.5, 1.5], colors="none", hatches=[pattern], zorder=2)
    drawn.set_edgecolor(HATCH)
    drawn.set_linewidth(0)


def plan_axes(ax: Axes | None) -> Axes:
    """Return axes for positions seen from above, those of a new figure for None."""
    if ax is None:
        from matplotlib import pyplot

        ax = pyplot.figure().add_subplot()
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    return ax


def _array(tensor: Tensor) -> NDArray[Any]:
    return np.asarray(tensor.detach().cpu())
