"""Spectra as the array sees them: the zenith in the middle, its plane on the rim."""

from __future__ import annotations

from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tasks.page.figures import LABEL, STYLE, colour_bar, plain

MAX_DIFFERENCE = 0.5  # of a magnitude in [0, 1]: end of the scale of differences and standard deviations
TRUTH, PEAK = "#ffffff", "#cf4a4a"
Direction = tuple[float, float]  # azimuth, elevation [deg]
SCALES = {
    "measured": ("viridis", 0.0, 1.0),
    "predicted": ("viridis", 0.0, 1.0),
    "difference": ("RdBu_r", -MAX_DIFFERENCE, MAX_DIFFERENCE),
    "standard deviation": ("magma", 0.0, MAX_DIFFERENCE),
}


def spectra(images: dict[str, NDArray[Any]], title: str, truth: Direction | None = None) -> Figure:
    """Return a panel with one hemisphere for each image, two in a row.

    Azimuth runs counter-clockwise from the right. Magnitudes have the fixed scales of `SCALES`.

    Args:
        images: Values (n_elevation, n_azimuth) of a hemisphere whose last row is the zenith, by kind: keys of `SCALES`.
        title: Title of the panel.
        truth: True direction, a cross. The ring is the peak of each magnitude.
    """
    n_rows = -(-len(images) // 2)
    with matplotlib.style.context(STYLE):
        figure = Figure(figsize=(4.8, 0.3 + 2.2 * n_rows), layout="constrained")
        axes = list(figure.subplots(n_rows, 2, squeeze=False, subplot_kw={"projection": "polar"}).flat)
    for ax, (kind, image) in zip(axes, images.items(), strict=False):
        colours, low, high = SCALES[kind]
        n_elevation, n_azimuth = image.shape
        step = 2 * np.pi / n_azimuth
        azimuth = (np.arange(n_azimuth + 1) - 0.5) * step  # edges of the pixels
        radius = np.maximum(90 - 90 * (np.arange(n_elevation + 1) + 0.5) / n_elevation, 0)  # from the zenith [deg]
        drawn = ax.pcolormesh(azimuth, radius, image, cmap=colours, vmin=low, vmax=high, rasterized=True)
        ax.set(yticks=(), ylim=(0, 90), xticks=np.deg2rad((0, 90, 180, 270)))
        ax.tick_params(labelsize=LABEL, pad=-2)
        ax.grid(visible=False)
        ax.set_title(kind, fontsize=9)
        if kind in ("measured", "predicted"):
            row, column = np.unravel_index(np.argmax(image), image.shape)
            at = (column * step, 90 - 90 * (row + 1) / n_elevation)
            _mark(ax, at, "o", PEAK)
            if truth is not None:
                _mark(ax, (np.deg2rad(truth[0]), 90 - truth[1]), "x", TRUTH)
        if kind == "measured":  # in the colours of the prediction beside it
            continue
        extend = {"difference": "both", "standard deviation": "max"}.get(kind, "neither")
        colour_bar(ax, drawn, extend=extend, pad=0.12)
    for ax in axes[len(images) :]:
        ax.set_visible(False)
    figure.suptitle(plain(title), fontsize=9)
    return figure


def _mark(ax: Any, at: tuple[float, float], marker: str, colour: str) -> None:
    """Draw a mark with a dark rim, visible on any colour."""
    for width, own in ((3.2, "#000001"), (1.6, colour)):
        ax.plot(*at, marker, color=own, markersize=8, markerfacecolor="none", markeredgewidth=width, clip_on=False)
