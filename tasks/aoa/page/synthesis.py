"""The report's sections on the quality of the synthetic spectra."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import matplotlib.style
import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pandas import DataFrame, concat

from swiftwrf import AngularGrid
from swiftwrf.models import FIELD_MODELS
from swiftwrf.plotting import polar_spectrum
from tasks.aoa.page.records import FractionRecords
from tasks.page import figures
from tasks.page.figures import LABEL, MAX_CURVES, STYLE, colour_bar, plain
from tasks.page.page import Plot, Section, Table, number

MAX_DIFFERENCE = 0.5  # of a magnitude in [0, 1]: end of the scale of differences and standard deviations
TRUTH, PEAK = "#ffffff", "#cf4a4a"
Direction = tuple[float, float]  # azimuth, elevation [deg]
SCALES = {
    "measured": ("viridis", 0.0, 1.0),
    "predicted": ("viridis", 0.0, 1.0),
    "difference": ("RdBu_r", -MAX_DIFFERENCE, MAX_DIFFERENCE),
    "standard deviation": ("magma", 0.0, MAX_DIFFERENCE),
}


@dataclass(frozen=True)
class Example:
    """A test spectrum and its prediction.

    Args:
        title: Row and quality.
        images: Values (n_elevation, n_azimuth) by kind, as `spectra` takes them.
        truth: True direction [deg]. None if it is unknown.
    """

    title: str
    images: dict[str, NDArray[Any]]
    truth: Direction | None


def examples(fraction: FractionRecords) -> list[Example]:
    """Return test spectra from the best to the worst prediction."""
    stored = fraction.arrays("examples")
    labels = fraction.table("errors").drop_duplicates("index").set_index("index")
    found = []
    for row, index in enumerate(stored["index"].tolist()):
        measured, predicted = (stored[kind][row] / 255.0 for kind in ("measured", "synthetic"))
        images = {"measured": measured, "predicted": predicted, "difference": predicted - measured}
        if "deviation" in stored:
            images["standard deviation"] = stored["deviation"][row] / 255.0
        truth = None
        if index in labels.index:
            label = labels.loc[index]
            truth = (float(label["truth_azimuth_deg"]), float(label["truth_elevation_deg"]))
        found.append(Example(f"row {index}, PSNR {stored['psnr_db'][row]:.1f} dB", images, truth))
    return found


def synthesis_section(fraction: FractionRecords) -> Section:
    """Return the quality of the spectra of each field model at the test positions, and examples."""
    rows = []
    for name, scores in fraction.mix["synthesis"].items():
        db = scores["psnr_db"]
        interval = f"{number(db['median'], 1)} [{number(db['low'], 1)}, {number(db['high'], 1)}]"
        rows.append([name, interval, number(scores["ssim"]["median"], 3), number(scores["l1"]["mean"], 4)])
    caption = (
        "Median PSNR (10 log10(1 / MSE)) with its 95 % interval, median SSIM (7 x 7 uniform window, data range 1), mean L1 "
        "over the test spectra, which no field model was fitted to."
    )
    table = Table(["field model", "PSNR [dB]", "SSIM", "L1"], rows, caption)
    return Section("", [], [table], [_examples(fraction)])


def _examples(fraction: FractionRecords) -> Plot:
    stored = fraction.arrays("examples")
    text = (
        f"Spectra at positions without a measurement, by {stored.get('synthesizer', 'swiftwrf')}, from the best to the "
        "worst by PSNR (quantiles 1, 0.8, ..., 0). The zenith is in the middle; cross: true direction, ring: peak. "
        f"Differences and standard deviations have a fixed scale up to {MAX_DIFFERENCE:g}."
    )
    if "deviation" in stored:
        text += f" Intervals of 80 % cover {float(stored['coverage']):.0%} of the pixels of all test spectra."
    panels = [spectra(one.images, one.title, one.truth) for one in examples(fraction)]
    return Plot(f"spectra-{fraction.file_name}", panels, text, _pixels(stored))


def similarity(fraction: FractionRecords) -> Plot:
    """Return the distribution of the SSIM of the best field models."""
    table = fraction.table("synthesis")
    own = table[table["synthesizer"].isin(list(FIELD_MODELS))]
    best = own.groupby("synthesizer")["ssim"].median().sort_values(ascending=False).index[:MAX_CURVES]
    groups = {str(name): own[own["synthesizer"] == name]["ssim"] for name in best}
    figure, axes = figures.panel(5.4, 3.3)
    figures.cdf(axes, fraction.palette, groups, "SSIM", limit=1)
    caption = f"Distribution of the SSIM over the test spectra, {fraction.title}."
    return Plot(f"ssim-{fraction.file_name}", [figure], caption, own[["repeat", "index", "synthesizer", "ssim"]])


def _pixels(example: dict[str, NDArray[Any]]) -> DataFrame:
    """Return the pixels of the spectra in 256 steps, one row of pixels a row."""
    kinds = [kind for kind in ("measured", "synthetic", "deviation") if kind in example]
    images = np.stack([example[kind] for kind in kinds], axis=1)  # (n, kinds, H, W)
    n, _, rows, columns = images.shape
    names = {
        "index": np.repeat(example["index"], len(kinds) * rows),
        "kind": np.tile(np.repeat(kinds, rows), n),
        "row": np.tile(np.arange(rows), n * len(kinds)),
    }
    table = DataFrame(images.reshape(-1, columns), columns=[f"column_{i}" for i in range(columns)])
    return concat([DataFrame(names), table], axis=1)


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
