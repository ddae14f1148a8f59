"""Charts of the pages, as options of Apache ECharts: layers of a chart, and the data that they show.

A layer has a name. Data that change are sent by that name, without the other layers.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from swiftwrf import AngularGrid
from tasks.page.maps import Corners

Option = dict[str, Any]
Data = list[Any]
Values = NDArray[np.floating]
INK, HALO = "black", "white"
CROSS = "path://M0 2L2 0L8 6L14 0L16 2L10 8L16 14L14 16L8 10L2 16L0 14L6 8Z"
BAR = "bar"  # name of the colour bar
N_STOPS = 17  # of a colour bar
DISC_PX = 240
PLAN_MARGIN = 0.04  # of the longer side
MIN_PLAN_ASPECT = 0.4  # a path along one axis needs room to drag across it
PICTURE = """(params, api) => {
    const polar = params.coordSys.type === "polar" ? params.coordSys : null;
    const [left, top] = polar ? [polar.cx - polar.r, polar.cy - polar.r] : api.coord([api.value(0), api.value(3)]);
    const [right, bottom] = polar ? [polar.cx + polar.r, polar.cy + polar.r] : api.coord([api.value(1), api.value(2)]);
    const [width, height] = [api.value(4), api.value(5)];
    const style = {image: api.ordinalRawValue(7), x: 0, y: 0, width, height, opacity: api.value(6)};
    return {type: "image", x: left, y: top, scaleX: (right - left) / width, scaleY: (bottom - top) / height, style};
}"""


def pictures(name: str, system: str = "cartesian2d") -> Option:
    """Return a layer of one picture, for data of `picture`."""
    dimensions = ["x0", "x1", "y0", "y1", "width", "height", "opacity", {"name": "image", "type": "ordinal"}]
    option = {"type": "custom", "coordinateSystem": system, "dimensions": dimensions, ":renderItem": PICTURE}
    return option | {"id": name, "silent": True, "clip": True, "data": []}


def picture(image: Image.Image, corners: Corners, opacity: float = 1.0) -> Data:
    """Return the data of a picture whose edges are x0, x1, y0, y1.

    In polar coordinates the picture fills the square around the disc.
    """
    stream = io.BytesIO()
    image.save(stream, "PNG", compress_level=1)  # higher levels take twice the time for a tenth of the bytes
    content = "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode()
    return [[*corners, image.width, image.height, opacity, content]]


def stripes(where: NDArray[np.bool_]) -> Values:
    """Return pixels of diagonal stripes, six by six for each cell of a map (rows, columns): 1 on a stripe, else nan.

    Example:
        >>> stripes(np.array([[True, False]])).shape
        (6, 12)
    """
    inside = np.kron(where, np.ones((6, 6))) > 0
    row, column = np.indices(inside.shape)
    return np.where(inside & ((row + column) % 18 < 3), 1.0, np.nan)


def dots(name: str, colour: str, size: float, system: str = "cartesian2d", **style: Any) -> Option:
    """Return a layer of dots, for data of `points`."""
    look = {"opacity": 1, "color": colour} | style
    option = {"type": "scatter", "coordinateSystem": system, "symbolSize": size, "itemStyle": look}
    return option | {"id": name, "silent": True, "data": []}


def crosses(name: str, colour: str, system: str = "cartesian2d") -> Option:
    """Return a layer of crosses with a dark rim."""
    return dots(name, colour, 16, system, borderColor=INK, borderWidth=1) | {"symbol": CROSS}


def lines(name: str, colour: str = "currentColor", width: float = 2.5, kind: str = "solid") -> Option:
    """Return a layer of lines, for data of `paths`."""
    style = {"color": colour, "width": width, "type": kind}
    return {"type": "line", "id": name, "silent": True, "showSymbol": False, "lineStyle": style, "data": []}


def points(position: ArrayLike, values: ArrayLike | None = None) -> Data:
    """Return the data of dots at positions (n, 2 or 3) [m], with values (n,) that a colour bar colours."""
    columns = np.asarray(position, dtype=float)[:, :2]
    found: Data = (columns if values is None else np.column_stack([columns, values])).round(4).tolist()
    return found


def named(position: ArrayLike, name: str, side: str = "right", **style: Any) -> Option:
    """Return the datum of one position (2 or 3,) [m] with its name beside it."""
    x, y = np.asarray(position, dtype=float)[:2].round(4).tolist()
    label = {"show": bool(name), "formatter": name, "position": side, "color": INK}
    return {"value": [x, y], "label": label | {"textBorderColor": HALO, "textBorderWidth": 3}, "itemStyle": style}


def paths(several: Iterable[ArrayLike]) -> Data:
    """Return the data of several paths, each (n, 2 or 3) [m]."""
    return [point for path in several for point in [*points(path), ["-", "-"]]]


def circle(centre: ArrayLike, radius: float) -> Values:
    """Return a path around a position (2 or 3,) [m], (n, 2)."""
    angle = np.linspace(0, 2 * np.pi, 73)
    return np.asarray(centre, dtype=float)[:2] + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def colour_bar(colours: str, limits: tuple[float, float], label: str, layer: str, extend: str = "neither") -> Option:
    """Return a colour bar of a matplotlib colour map for the values of a layer, with quantity and unit.

    Ends that stand for all values beyond are "neither", "max" or "both".
    """
    low, high = (f"{value:.3g}" for value in limits)
    ends = [f"{'≥ ' * (extend != 'neither')}{high}  {label}", f"{'≤ ' * (extend == 'both')}{low}"]
    bar = {"id": BAR, "type": "continuous", "show": True, "min": limits[0], "max": limits[1], "text": ends}
    stops = [to_hex(colormaps[colours](i / (N_STOPS - 1))) for i in range(N_STOPS)]
    place = {"orient": "horizontal", "left": 34, "bottom": 0, "itemWidth": 14, "itemHeight": 120, "hoverLink": False}
    colour = {"inRange": {"color": stops}, "textStyle": {"color": "currentColor"}, "dimension": 2}
    return bar | place | colour | {"seriesId": layer}


def axis(low: float, high: float, name: str = "", interval: float | None = None, gap: float = 24) -> Option:
    """Return an axis of numbers, with an interval one of angles [deg]."""
    label: Option = {"color": "currentColor", "hideOverlap": True}
    if interval is None:  # ends that are no round numbers are not written
        label |= {"showMinLabel": False, "showMaxLabel": False}
    else:
        label |= {"formatter": "{value}°"}
    rule = {"show": True, "onZero": False, "lineStyle": {"color": "currentColor", "opacity": 0.5}}
    grid = {"lineStyle": {"color": "currentColor", "opacity": 0.12}}
    title = {"name": name, "nameLocation": "middle", "nameGap": gap, "nameTextStyle": {"color": "currentColor"}}
    option = title | {"type": "value", "min": low, "max": high, "axisLine": rule, "splitLine": grid}
    return option | ({} if interval is None else {"interval": interval}) | {"axisLabel": label}


def around(*positions: ArrayLike) -> Corners:
    """Return the edges x0, x1, y0, y1 of a plan that contains all finite positions, each (n, 2 or 3) [m].

    Example:
        >>> around([[0.0, 0.0, 1.0], [10.0, 5.0, 1.0]])
        (-0.4, 10.4, -0.4, 5.4)
    """
    xy = np.concatenate([np.asarray(some, dtype=float)[..., :2].reshape(-1, 2) for some in positions])
    xy = xy[np.isfinite(xy).all(axis=1)]
    low, high = xy.min(axis=0), xy.max(axis=0)
    longest = float((high - low).max()) or 1.0
    margin = np.maximum(MIN_PLAN_ASPECT * longest - (high - low), 0) / 2 + PLAN_MARGIN * longest
    (x0, y0), (x1, y1) = (low - margin).tolist(), (high + margin).tolist()
    return x0, x1, y0, y1


def rectangle(spectrum: Values, grid: AngularGrid) -> tuple[Values, Corners]:
    """Return a spectrum (n_elevation, n_azimuth) as rows from the zenith down, and its edges [deg].

    The first column repeats at 360 degrees, the lowest row below.
    """
    values = np.pad(np.pad(spectrum, ((1, 0), (0, 0)), mode="edge"), ((0, 0), (0, 1)), mode="wrap")[::-1]
    n_elevation, n_azimuth = values.shape
    x0 = np.degrees(grid.azimuth_start - grid.azimuth_step / 2)
    y0 = np.degrees(grid.elevation_start - 1.5 * grid.elevation_step)
    x1, y1 = x0 + n_azimuth * np.degrees(grid.azimuth_step), y0 + n_elevation * np.degrees(grid.elevation_step)
    return values, (float(x0), float(x1), float(y0), float(y1))


def disc(spectrum: Values, grid: AngularGrid) -> Values:
    """Return a spectrum (n_elevation, n_azimuth) seen along the normal of the array, nan outside of the hemisphere.

    The x axis of the array points to the right, azimuth runs counter-clockwise, the plane of the array is the rim.
    """
    nearest = _nearest_direction(grid)
    return np.where(nearest < 0, np.nan, spectrum.ravel()[nearest])


@cache
def _nearest_direction(grid: AngularGrid) -> NDArray[np.integer]:
    """Return the flat index of the nearest direction for every pixel of a disc, -1 outside the hemisphere."""
    line = (np.arange(DISC_PX) + 0.5) / DISC_PX * 2 - 1
    right, up = np.meshgrid(line, -line)
    azimuth, elevation = np.arctan2(up, right) % (2 * np.pi), (1 - np.hypot(right, up)) * np.pi / 2
    column = np.round((azimuth - grid.azimuth_start) / grid.azimuth_step).astype(int) % grid.n_azimuth
    row = np.round((elevation - grid.elevation_start) / grid.elevation_step).astype(int)
    return np.where(elevation < 0, -1, row.clip(0, grid.n_elevation - 1) * grid.n_azimuth + column)


def spectrum(polar: bool, colours: str, high: float, extend: str, peak: str, sight: str) -> Option:
    """Return the options of a chart of a spectrum up to a value, with a ring at the peak and a cross at the line of sight.

    In polar coordinates directions are (angle to the normal, azimuth), else (azimuth, elevation) [deg].
    """
    system = "polar" if polar else "cartesian2d"
    ring = dots("peak", "transparent", 14, system, borderColor=peak, borderWidth=3)
    layers = [pictures("spectrum", system), ring, crosses("sight", sight, system)]
    bar = colour_bar(colours, (0.0, high), "magnitude", "spectrum", extend)
    option = {"animation": False, "series": [layer | {"z": 2 + n} for n, layer in enumerate(layers)], "visualMap": bar}
    if not polar:
        box = {"left": 34, "right": 14, "top": 8, "bottom": 54, "outerBoundsMode": "none"}
        return option | {"grid": box, "xAxis": axis(0, 360, interval=90), "yAxis": axis(0, 90, interval=30)}
    turn = axis(0, 360, interval=90) | {"startAngle": 0, "clockwise": False}
    tilt = axis(0, 90, interval=30) | {
        "axisLabel": {"show": False},
        "splitLine": {"lineStyle": {"color": "white"}},
        "z": 10,
    }
    return option | {"polar": {"center": ["50%", "45%"], "radius": "64%"}, "angleAxis": turn, "radiusAxis": tilt}
