"""Draw the figures of README, concepts and gallery: python benchmarks/doc_figures.py --data DIR.

The result in README uses the measured data sets tetam-tracks and s23-200 in DIR. All other figures use built-in scenes.
Text and axes are grey on a transparent background, so that the figures are legible on light and on dark pages.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
import torch
import tyro
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from scipy.stats import norm

import swiftwrf
from swiftwrf.contrib.survey.plan import plan_coverage
from swiftwrf.plotting import hatch, mark_direction, polar_spectrum
from swiftwrf.positions import inside
from swiftwrf.rssi.maps import RssiMap
from tasks.page.figures import as_svg

FOLDER = Path(__file__).parent.parent / "docs" / "figures"
INK, TRAIN, TEST, SYNTHETIC = (
    "#727a85",
    "#3b82c4",
    "#d1662b",
    "#2a9d6f",
)  # contrast of at least 3 to 1 on white and black
STYLE: dict[str, Any] = {
    "font.size": 9,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": INK,
    "axes.titlesize": 9,
    "axes.titlecolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": INK,
    "ytick.color": INK,
    "grid.color": INK,
    "grid.alpha": 0.4,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "legend.frameon": False,
}
ROOM_M = (5.0, 4.8)  # sides of the sketched room
ARRAY_M, SOURCE_M = np.array([0.1, 2.4]), np.array([2.6, 3.3])
RECEIVER = "sensor41"  # of tetam-tracks, the one with most detections
THRESHOLD_DBM = -65


def main(data: Path, only: str = "") -> None:
    """Draw the figures.

    Args:
        data: Folder that contains tetam-tracks and s23-200.
        only: Name of one figure. Defaults to all.
    """
    figures = {draw.__name__: draw for draw in (spectrum, synthetic, splits, intervals, locating, coverage, walls)}
    figures["result"] = partial(result, data)
    with matplotlib.style.context(STYLE):
        for name, draw in figures.items():
            if only in ("", name):
                _save(name, draw())


def spectrum() -> Figure:
    """Return a plan of a room with the direct path and two reflections, and the spectrum of such a position."""
    figure = Figure(figsize=(8.5, 3.4), layout="constrained")
    plan = figure.add_subplot(1, 2, 1)
    width, depth = ROOM_M
    plan.plot([0, width, width, 0, 0], [0, 0, depth, depth, 0], color=INK)
    plan.plot(*zip(SOURCE_M, ARRAY_M, strict=True), color=TRAIN, label="direct path")
    for wall, colour in ((0.0, SYNTHETIC), (depth, TEST)):
        image = np.array([SOURCE_M[0], 2 * wall - SOURCE_M[1]])
        at = ARRAY_M + (image - ARRAY_M) * (wall - ARRAY_M[1]) / (image - ARRAY_M)[1]
        plan.plot(*zip(SOURCE_M, at, ARRAY_M, strict=True), "--", color=colour, label="reflection")
    plan.plot(*ARRAY_M, "s", color=INK, markersize=9)
    plan.plot(*SOURCE_M, "o", color=INK, markersize=7)
    plan.annotate("array", ARRAY_M, (8, -14), textcoords="offset points")
    plan.annotate("transmitter", SOURCE_M, (9, -4), textcoords="offset points")
    plan.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="room, seen from above")
    plan.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=3, fontsize=8)
    at = torch.tensor([[*SOURCE_M.tolist(), 1.2]])
    data = swiftwrf.simulated_room(position=at, phase_noise=0.0)
    axes = figure.add_subplot(1, 2, 2, projection="polar")
    polar_spectrum(data.spectrum[0], data.grid, axes)
    mark_direction(axes, *data.label[0].tolist(), "line of sight")
    axes.set_title("spectrum, seen along the array's normal")
    return figure


def synthetic() -> Figure:
    """Return positions with measured and with synthetic spectra, and one synthetic spectrum beside the hidden one."""
    data = swiftwrf.simulated_room()
    measured, hidden = data.subset(torch.arange(90)), data.subset(torch.arange(90, 300))
    prediction = swiftwrf.make_model("coarray").fit(measured).predict(hidden.position)
    row = _median_row(prediction.mean, hidden.spectrum)
    figure = Figure(figsize=(8.5, 3.0), layout="constrained")
    plan = figure.add_subplot(1, 3, 1)
    for part, colour, label in ((hidden, SYNTHETIC, "synthetic"), (measured, TRAIN, "measured")):
        plan.plot(*part.position[:, :2].T.numpy(), ".", color=colour, label=label)
    plan.plot(*hidden.position[row, :2].numpy(), "o", color=TEST, markersize=11, fillstyle="none", label="shown right")
    plan.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="positions")
    plan.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.25), ncols=3, fontsize=8, columnspacing=1, handletextpad=0.2
    )
    for place, (title, value) in enumerate({"synthetic": prediction.mean, "measured, hidden": hidden.spectrum}.items()):
        axes = figure.add_subplot(1, 3, place + 2, projection="polar")
        polar_spectrum(value[row], data.grid, axes)
        axes.set_title(title)
    return figure


def splits() -> Figure:
    """Return the training and test positions of a random and of a block split."""
    figure = Figure(figsize=(8.5, 3.2), layout="constrained")
    for place, split in enumerate(("random", "block"), 1):
        axes = figure.add_subplot(1, 2, place)
        for part, colour, label in zip(
            swiftwrf.rssi_room(300).split(split), (TRAIN, TEST), ("train", "test"), strict=True
        ):
            axes.plot(*part.transmitter_position[:, :2].T.numpy(), ".", color=colour, label=label)
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=f"split {split}")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)
    return figure


def intervals() -> Figure:
    """Return the 80 % intervals of test rows at one receiver, with the measurements inside and outside."""
    train, test = swiftwrf.rssi_room().split()
    prediction = swiftwrf.RssiModel().fit(train).predict(test.transmitter_position)
    measured = test.rssi_dbm[:, 5]
    shown = measured.isfinite().nonzero()[:60, 0]
    shown = shown[prediction.mean[shown, 5].argsort()]
    low, high = (end[shown, 5].numpy() for end in prediction.interval(0.8))
    measured, row = measured[shown].numpy(), np.arange(len(shown))
    inside = (low <= measured) & (measured <= high)
    figure = Figure(figsize=(8.5, 3.0), layout="constrained")
    axes = figure.add_subplot()
    axes.vlines(row, low, high, color=INK, linewidth=3, alpha=0.5, label="80 % interval")
    axes.plot(row[inside], measured[inside], "o", color=TRAIN, markersize=4, label=f"inside: {inside.sum()}")
    axes.plot(row[~inside], measured[~inside], "D", color=TEST, markersize=4, label=f"outside: {(~inside).sum()}")
    axes.set(xlabel="test rows, sorted by prediction", ylabel="RSSI [dBm]")
    axes.legend(loc="upper left")
    return figure


def locating() -> Figure:
    """Return the posteriors over the position of two test rows, with the true positions."""
    train, test = swiftwrf.rssi_room().split()
    posterior = swiftwrf.RssiLocator(n_cells=2000).fit(train).locate(test.rssi_dbm)
    order = posterior.credible_radius().argsort()
    figure = Figure(figsize=(8.5, 3.4), layout="constrained")
    for place, quantile in enumerate((0.2, 0.9), 1):
        row = int(order[int(quantile * len(order))])
        axes = figure.add_subplot(1, 2, place)
        posterior.plot(row, axes).collections[0].set_rasterized(True)
        axes.plot(*test.transmitter_position[row, :2].numpy(), "*", color=INK, markersize=10, label="true position")
        axes.set_title(f"{int(test.rssi_dbm[row].isfinite().sum())} receivers detect the transmitter")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=3, columnspacing=1)
    return figure


def coverage() -> Figure:
    """Return the coverage of three receivers of the simulated floor, before and after one further access point."""
    figure = Figure(figsize=(8.5, 3.2), layout="constrained")
    floor = swiftwrf.rssi_room(n=200).columns([0, 1, 2])
    found = plan_coverage(swiftwrf.RssiModel().fit(floor), floor, above_dbm=-60)
    for axes, title, value in zip(figure.subplots(1, 2), ("as surveyed", "one more"), found.probability, strict=True):
        drawn = axes.scatter(
            *found.cells[:, :2].T, c=value, s=14, marker="s", cmap="cividis", vmin=0, vmax=1, rasterized=True
        )
        axes.plot(*floor.receiver_position[:, :2].T, "^", color=TRAIN)
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=f"probability above -60 dBm, {title}")
    axes.plot(*found.candidates[list(found.chosen), :2].T, "X", color=TEST, markersize=9)
    figure.colorbar(drawn, ax=figure.axes, label="probability")
    return figure


def walls() -> Figure:
    """Return the walls of the built-in room by its truth, and those that 72 spectra determine."""
    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axes = figure.add_subplot()
    measured = swiftwrf.simulated_room(n=72)
    model = swiftwrf.GeometryModel().fit(measured)
    assert model.room is not None
    for plane in model.room.planes:
        axis = int(np.abs(plane.normal).argmax())
        if axis < 2:
            style = "-" if plane.probability >= 0.9 else "--"
            draw = (axes.axvline, axes.axhline)[axis]
            draw(plane.offset_m * plane.normal[axis], color=SYNTHETIC, linestyle=style)
    axes.plot(*measured.position[:, :2].T, ".", color=TRAIN, label="measured spectra")
    axes.plot(*measured.fixed_position[:2], "s", color=INK, label="array")
    axes.set(
        aspect="equal", xlabel="x [m]", ylabel="y [m]", title="walls that spectra determine (dashed: not identifiable)"
    )
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, fontsize=8)
    return figure


def result(data: Path) -> Figure:
    """Return a radio map with its coverage probability, and a measured spectrum beside the prediction at its position."""
    figure = Figure(figsize=(9, 6.6), layout="constrained")
    maps, spectra = figure.subfigures(2, 1)
    walks = swiftwrf.load_rssi(data / "tetam-tracks")
    chart = RssiMap.predict(swiftwrf.RssiModel().fit(walks)).receivers([RECEIVER])
    column = walks.receiver_names.index(RECEIVER)
    probability = norm.sf(THRESHOLD_DBM, chart.mean[0], chart.std[0])
    left, right = maps.subplots(1, 2)
    known = walks.transmitter_position.numpy()
    image = _image(left, chart, chart.mean[0], known, {"vmin": -85, "vmax": -45}, "RSSI [dBm]")
    x, y, _ = walks.transmitter_position[::3].T.numpy()
    left.scatter(x, y, c=walks.rssi_dbm[::3, column], s=9, norm=image.norm, edgecolors="white", linewidths=0.3)
    left.set_title("RSSI of one receiver: predicted, and measured (dots)")
    _image(right, chart, probability, known, {"vmin": 0, "vmax": 1, "cmap": "cividis"}, "probability")
    right.set_title(f"probability that a measurement exceeds {THRESHOLD_DBM} dBm")
    train, test = swiftwrf.load_spectra(data / "s23-200").split("random")
    predicted = swiftwrf.SwiftWRF().fit(train).predict(test.position).mean
    row = _median_row(predicted, test.spectrum)
    for place, (title, value) in enumerate({"measured": test.spectrum, "predicted": predicted}.items(), 1):
        axes = spectra.add_subplot(1, 2, place, projection="polar")
        polar_spectrum(value[row], train.grid, axes)
        axes.set_title(f"spectrum at a test position, {title}")
    return figure


def _image(
    axes: Axes, chart: RssiMap, values: np.ndarray, known: np.ndarray, style: dict[str, Any], label: str
) -> AxesImage:
    """Draw a map, hatched outside of the measured positions."""
    image = axes.imshow(values, origin="lower", extent=chart.corners, **style)
    hatch(axes, chart.x, chart.y, ~inside(np.stack(np.meshgrid(chart.x, chart.y), axis=-1), known))
    axes.figure.colorbar(image, ax=axes, label=label)
    axes.set(xlabel="x [m]", ylabel="y [m]")
    return image


def _median_row(predicted: torch.Tensor, true: torch.Tensor) -> int:
    """Return the row whose mean squared error is the median, so that neither a good nor a bad one is picked."""
    error = (predicted - true).square().mean(dim=(1, 2))
    return int(error.argsort()[math.floor(len(error) / 2)])


def _save(name: str, figure: Figure) -> None:
    FigureCanvasAgg(figure)
    (FOLDER / f"{name}.svg").write_text(as_svg(figure))
    print(f"docs/figures/{name}.svg")


if __name__ == "__main__":
    tyro.cli(main)
