"""The report's section on the synthesized field: strongest directions over the region, primitives along a walk."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse
from numpy.typing import NDArray
from pandas import DataFrame

from swiftwrf.plotting import corners_of
from tasks.aoa.page.records import FractionRecords
from tasks.page import figures
from tasks.page.page import Plot, Section

MIN_SHIFT_RAD = np.deg2rad(0.1)  # smallest visible shift of a primitive's mean along the walk


def field_section(fraction: FractionRecords) -> Section | None:
    """Return maps of the peak direction, and the primitives along a walk; None if the run has neither."""
    names = fraction.synthesizers(fraction.mix["methods"])
    plots = [_map(fraction, name, field) for name in names if (field := fraction.arrays(f"field-{name}"))]
    if motion := fraction.arrays("motion"):
        plots.append(_motion(fraction, motion))
    return Section("", plots=plots) if plots else None


def _map(fraction: FractionRecords, name: str, field: dict[str, NDArray[Any]]) -> Plot:
    x, y, z = field["position"].T
    data = DataFrame(
        {
            "x_m": x,
            "y_m": y,
            "z_m": z,
            "azimuth_deg": np.rad2deg(field["azimuth"]),
            "elevation_deg": np.rad2deg(field["elevation"]),
            "magnitude": field["magnitude"],
        }
    )
    shown = (
        ("azimuth_deg", "azimuth [deg]", "twilight", 0, 360),
        ("elevation_deg", "elevation [deg]", "viridis", 0, 90),
        ("magnitude", "magnitude of the peak", "magma", 0, 1),
    )
    panels = []
    for column, label, colours, low, high in shown:
        figure, ax = figures.panel(4, 3.4)
        drawn = ax.scatter(x, y, c=data[column], s=24, cmap=colours, vmin=low, vmax=high, linewidths=0, rasterized=True)
        ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        figures.colour_bar(ax, drawn, label)
        panels.append(figure)
    caption = (
        f"Where the strongest signal comes from, as {name} predicts it, at {len(x)} places in the region of the "
        "measured positions, at their median height: azimuth, elevation, magnitude."
    )
    return Plot(f"field-{name}-{fraction.file_name}", panels, caption, data)


def _motion(fraction: FractionRecords, motion: dict[str, NDArray[Any]]) -> Plot:
    mean, strength = np.rad2deg(motion["mean"]), motion["strength"]
    walked = np.linalg.norm(motion["walk"] - motion["walk"][0], axis=1)
    first, places = figures.panel(5.4, 3.4)
    moves = np.ptp(motion["mean"], axis=0).max() > MIN_SHIFT_RAD
    _draw_primitives(places, mean, np.rad2deg(1.0) ** 2 * motion["covariance"], strength.mean(axis=0))
    if moves:
        for k in range(mean.shape[1]):
            places.plot(*mean[:, k].T, color="#cf4a4a", linewidth=0.8)
    second, along = figures.panel(5.4, 3.4)
    _draw_strengths(along, walked, strength)
    what = "red: the way of their means" if moves else "their means stay, their responses change"
    caption = (
        f"The {mean.shape[1]} strongest primitives. Left: where they lie (one standard deviation; darker is stronger; "
        f"{what}). Right: the strength of each along a straight walk through the region, along its longest extent."
    )
    n_steps, n = strength.shape
    data = DataFrame(
        {
            "walked_m": np.repeat(walked, n),
            "primitive": np.tile(np.arange(n), n_steps),
            "azimuth_deg": mean[..., 0].ravel(),
            "elevation_deg": mean[..., 1].ravel(),
            "strength": strength.ravel(),
        }
    )
    return Plot(f"motion-{fraction.file_name}", [first, second], caption, data)


def _draw_primitives(ax: Axes, mean: NDArray[Any], covariance: NDArray[Any], strength: NDArray[Any]) -> None:
    """An ellipse each at the first step of the walk; means and covariances in degrees."""
    for (azimuth, elevation), matrix, shade in zip(
        mean[0], covariance, strength / max(strength.max(), 1e-12), strict=True
    ):
        values, vectors = np.linalg.eigh(matrix)
        width, height = 2 * np.sqrt(values)
        angle = np.rad2deg(np.arctan2(vectors[1, 0], vectors[0, 0]))
        style: dict[str, Any] = {"facecolor": "none", "edgecolor": "#3a7fd5", "alpha": float(0.15 + 0.85 * shade)}
        ax.add_patch(Ellipse((azimuth, elevation), width, height, angle=angle, linewidth=1.2, **style))
    ax.set(xlim=(0, 360), ylim=(0, 90), xlabel="azimuth [deg]", ylabel="elevation [deg]", xticks=range(0, 361, 90))


def _draw_strengths(ax: Axes, walked: NDArray[Any], strength: NDArray[Any]) -> None:
    left, right, *_ = corners_of(walked, walked)
    extent = (left, right, strength.shape[1] - 0.5, -0.5)
    drawn = ax.imshow(strength.T, aspect="auto", extent=extent, cmap="magma", interpolation="nearest")
    ax.set(xlabel="walked [m]", ylabel="primitive, by strength")
    ax.grid(visible=False)
    figures.colour_bar(ax, drawn, "path gain")
