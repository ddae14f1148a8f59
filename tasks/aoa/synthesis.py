"""The report's sections on the quality of the synthetic spectra."""

from __future__ import annotations

from typing import Any

import matplotlib.style
import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pandas import DataFrame, concat

from swiftwrf import AngularGrid
from swiftwrf.plotting import polar_spectrum
from tasks.aoa.records import FractionRecords
from tasks.page.figures import LABEL, STYLE, colour_bar, plain
from tasks.page.page import Plot, Table, number
from tasks.page.shared import with_interval

MAX_DIFFERENCE = 0.5  # of a magnitude in [0, 1]: end of the scale of standard deviations of one spectrum
TRUTH, PEAK = "#ffffff", "#cf4a4a"
Direction = tuple[float, float]  # azimuth, elevation [deg]
Images = dict[str, NDArray[Any]]  # values (n_elevation, n_azimuth) by kind
SCALES = {
    "measured": ("viridis", 0.0, 1.0),
    "predicted": ("viridis", 0.0, 1.0),
    "difference": ("RdBu_r", -1.0, 1.0),  # of the end of the scale
    "standard deviation": ("magma", 0.0, 1.0),
}


def examples(fraction: FractionRecords) -> list[tuple[Images, str, Direction | None]]:
    """Return images, title and true direction, if known, of test spectra, from the best to the worst prediction."""
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
        found.append((images, f"row {index}, PSNR {stored['psnr_db'][row]:.1f} dB", truth))
    return found


def quality_table(fraction: FractionRecords) -> Table:
    """Return the quality of the spectra of each field model at held-out and at test positions."""
    choice, rows = fraction.mix["choice"], []
    for name, scores in sorted(fraction.mix["synthesis"].items(), key=lambda item: -item[1]["psnr_db"]["median"]):
        held_out = number(choice["psnr_db"].get(name), 1) if choice else ""
        quality = (number(scores["ssim"]["median"], 3), number(scores["l1"]["mean"], 4))
        rows.append(
            [name, held_out, with_interval(scores["psnr_db"], 1), *quality, number(scores["seconds"]["fit"], 1)]
        )
    caption = (
        "PSNR (10 log10(1 / MSE)): mean without the extreme tenths over held-out measured spectra, by which the field model "
        "is chosen, and median over the test spectra with its 95 % interval. Median SSIM (7 x 7 uniform window, data range "
        "1) and mean L1 over the test spectra, which no field model was fitted to. Shaded: the field model of the synthetic "
        "spectra in the answer."
    )
    columns = ["field model", "held-out PSNR [dB]", "PSNR [dB]", "SSIM", "L1", "fit [s]"]
    chosen = frozenset(fraction.synthesizers([fraction.turbo_method])[:1])
    return Table(columns, rows, caption, chosen)


def examples_plot(fraction: FractionRecords) -> Plot:
    """Return measured spectra and their predictions."""
    stored, found = fraction.arrays("examples"), examples(fraction)
    small = [image.ravel() for images, *_ in found for kind, image in images.items() if SCALES[kind][0] != "viridis"]
    most = max(float(np.quantile(np.abs(np.concatenate(small)), 0.99)), 1e-3)  # end of a scale that shows them
    text = (
        f"Spectra at positions without a measurement, by {stored['synthesizer']}, from the best to the "
        "worst by PSNR (quantiles 1, 0.5, 0). The array's normal is in the middle; cross: true direction, ring: peak. "
        f"Differences and standard deviations have a scale up to {most:.2g}, which 99 % of them are below."
    )
    if "deviation" in stored:
        text += f" Intervals of 80 % cover {float(stored['coverage']):.0%} of the pixels of all test spectra."
    panels = [spectra(*example, most) for example in found]
    return Plot(f"spectra-{fraction.file_name}", panels, text, _pixels(stored))


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


def spectra(images: Images, title: str, truth: Direction | None = None, most: float = MAX_DIFFERENCE) -> Figure:
    """Return a panel with one hemisphere for each image, two in a row.

    Azimuth runs counter-clockwise from the right. Images (n_elevation, n_azimuth), whose last row is the zenith, are by
    kind, with the scale of `SCALES`. `most` ends that of differences and standard deviations. A cross marks the true
    direction, a ring the peak.
    """
    n_rows = -(-len(images) // 2)
    with matplotlib.style.context(STYLE):
        figure = Figure(figsize=(4.6, 0.3 + 2.1 * n_rows), layout="constrained")
        axes = list(figure.subplots(n_rows, 2, squeeze=False, subplot_kw={"projection": "polar"}).flat)
    for ax, (kind, image) in zip(axes, images.items(), strict=False):
        colours, low, high = SCALES[kind]
        if kind not in ("measured", "predicted"):
            low, high = most * low, most * high
        grid, values = AngularGrid.of(image.shape), torch.from_numpy(image)
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
