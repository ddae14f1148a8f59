"""Maps in plan: values as colours, hatched where they are extrapolated."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree

from swiftwrf.plotting import corners_of

MIN_REACH = 1.5  # of the largest distance between neighbours, for positions on a line
HATCH = "#555b66"
TRANSPARENT = 255  # palette index of pixels without a value
Corners = tuple[float, float, float, float]  # x0, x1, y0, y1 [m]


def inside(position: ArrayLike, known: ArrayLike) -> NDArray[np.bool_]:
    """Return whether positions lie inside the convex hull of known ones, in plan.

    Known positions on a line have no hull. There a position is inside if it lies near one of them.

    Args:
        position: Positions (..., 2 or 3) [m].
        known: Known positions (n, 2 or 3) [m].

    Example:
        >>> inside([[0.5, 0.2], [2.0, 0.2]], [[0, 0], [1, 0], [0, 1], [1, 1]]).tolist()
        [True, False]
    """
    at, points = np.asarray(position, dtype=float)[..., :2], np.asarray(known, dtype=float)[:, :2]
    try:
        corners = points[ConvexHull(points).vertices]
        return np.asarray(Delaunay(corners).find_simplex(at) >= 0)
    except (QhullError, ValueError):
        tree = cKDTree(points)
        apart = tree.query(points, min(2, len(points)))[0].reshape(len(points), -1)[:, -1]
        return np.asarray(tree.query(at)[0] <= MIN_REACH * max(float(apart.max()), 1e-6))


def hatch(axes: Axes, x: NDArray[Any], y: NDArray[Any], known: ArrayLike) -> None:
    """Hatch the cells of a map with centres x (W,) and y (H,) [m] that lie outside of the known positions (n, 2 or 3)."""
    outside = np.pad(~inside(np.stack(np.meshgrid(x, y), axis=-1), known), 1, mode="edge")
    x0, x1, y0, y1 = corners_of(x, y)
    x, y = np.concatenate([[x0], x, [x1]]), np.concatenate([[y0], y, [y1]])
    if outside.any():
        with np.errstate(all="ignore"):
            drawn = axes.contourf(
                x, y, outside.astype(float), levels=[0.5, 1.5], colors="none", hatches=["////"], zorder=2
            )
        drawn.set_edgecolor(HATCH)
        drawn.set_linewidth(0)


def draw(
    axes: Axes,
    x: NDArray[Any],
    y: NDArray[Any],
    values: NDArray[Any],
    *,
    colours: str,
    limits: tuple[float, float],
    known: ArrayLike,
    plan: tuple[NDArray[Any], Corners] | None = None,
) -> Any:
    """Draw a map with hatching where it is extrapolated; return the image for a colour bar.

    Args:
        axes: Axes to draw in.
        x: Centres of the columns (W,) [m].
        y: Centres of the rows (H,) [m].
        values: Values (H, W).
        colours: Name of a matplotlib colour map.
        limits: Values of the first and the last colour.
        known: Measured positions (n, 2 or 3) [m].
        plan: Image of the floor and its corners x0, x1, y0, y1 [m], drawn below.
    """
    extent = corners_of(x, y)
    if plan is not None:
        axes.imshow(plan[0], extent=plan[1], aspect="equal", zorder=0)
    low, high = limits
    alpha = 0.75 if plan is not None else 1.0
    drawn = axes.imshow(
        values, origin="lower", extent=extent, cmap=colours, vmin=low, vmax=high, alpha=alpha, zorder=1, aspect="equal"
    )
    hatch(axes, x, y, known)
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.grid(visible=False)
    return drawn


def colour_image(values: NDArray[np.floating], colours: str, low: float = 0.0, high: float = 1.0) -> Image.Image:
    """Return an image of values (rows, columns), the first row on top; nan is transparent.

    Args:
        values: Values of the pixels.
        colours: Name of a matplotlib colour map.
        low: Value of its first colour.
        high: Value of its last colour.
    """
    scaled = (values - low) * (TRANSPARENT - 1) / (high - low or 1.0)
    image = Image.fromarray(
        np.where(np.isnan(values), TRANSPARENT, np.clip(scaled, 0, TRANSPARENT - 1)).astype(np.uint8)
    )
    rgb = colormaps[colours](np.linspace(0, 1, TRANSPARENT), bytes=True)[:, :3]
    image.putpalette(rgb.tobytes() + b"\0\0\0")
    image.info["transparency"] = TRANSPARENT
    return image
