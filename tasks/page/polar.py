"""Spectra as the array sees them: the zenith in the middle, its plane on the rim."""

from __future__ import annotations

from typing import Any

import matplotlib.style
import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from swiftwrf import AngularGrid
from swiftwrf.plotting import polar_spectrum
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
        grid, values = AngularGrid.hemisphere(*image.shape), torch.from_numpy(image)
        polar_spectrum(values, grid, ax, colours, (low, high), label=None)
        ax.set(yticks=(), xticks=np.deg2rad((0, 90, 180, 270)))
        ax.tick_params(labelsize=LABEL, pad=-2)
        ax.grid(visible=False)
        ax.set_title(kind, fontsize=9)
        if kind in ("measured", "predicted"):
            azimuth, elevation = grid.peak_direction(values[None])[0].tolist()
            _mark(ax, (azimuth, 90 - np.rad2deg(elevation)), "o", PEAK)
            if truth is not None:
                _mark(ax, (np.deg2rad(truth[0]), 90 - truth[1]), "x", TRUTH)
        if kind == "measured":  # in the colours of the prediction beside it
            continue
        extend = {"difference": "both", "standard deviation": "max"}.get(kind, "neither")
        colour_bar(ax, ax.collections[0], extend=extend, pad=0.12)
    for ax in axes[len(images) :]:
        ax.set_visible(False)
    figure.suptitle(plain(title), fontsize=9)
    return figure


def _mark(ax: Any, at: tuple[float, float], marker: str, colour: str) -> None:
    """Draw a mark with a dark rim, visible on any colour."""
    for width, own in ((3.2, "#000001"), (1.6, colour)):
        ax.plot(*at, marker, color=own, markersize=8, markerfacecolor="none", markeredgewidth=width, clip_on=False)
