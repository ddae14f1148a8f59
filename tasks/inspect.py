"""Inspection of measurements before a model is fitted: findings, and a page with figures."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
import yaml
from matplotlib.patches import Circle
from pandas import DataFrame
from torch import Tensor

from swiftwrf.array.angles import angular_distance, to_direction
from swiftwrf.array.beamforming import PHASE
from swiftwrf.contrib.diagnostics.inspection import Findings, inspect, propose_offsets
from swiftwrf.data import Rssi, Snapshots, Spectra
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS
from swiftwrf.errors import InputError
from swiftwrf.positions import nearest
from swiftwrf.rssi import fit_path_loss, log_distance
from swiftwrf.runtime.durable import write_json, write_text
from tasks.command import run_module
from tasks.configs import InspectConfig
from tasks.directory import new_directory
from tasks.environment import command, stamp
from tasks.options import READING, beside
from tasks.page import figures
from tasks.page.page import Number, Page, Plot, Section, Summary, Table, write_page
from tasks.source import Reading, reading
from tasks.terminal import NextStep, console, terminal

AXES = ("#cf4a4a", "#2a9165", "#3a7fd5")  # colours of x, y and normal
DOTS, NONE = "#3a7fd5", "#7f8794"  # with line of sight, without
MAX_DOTS = 2000
MIN_BINS_M = 1e-3  # of the bins of distances together


def run(config: InspectConfig) -> None:
    """Print the findings, and write a page and inspect.json.

    Raises:
        InputError: Measurements that cannot be read.
    """
    how = reading(config, config.source)
    out = Path(config.out) if config.out else Path("runs") / "inspect" / stamp()
    with new_directory(out, "an inspection") as folder:
        data = how.read(SPECTRA_FORMATS, SNAPSHOT_FORMATS, RSSI_FORMATS)
        kind = (
            data.quantity if isinstance(data, Rssi) else "array snapshots" if isinstance(data, Snapshots) else "spectra"
        )
        findings = inspect(data, grid=how.options.grid, beamformer=how.options.beamformer or PHASE)
        for column in data.labels if isinstance(data, Rssi) else ():
            with suppress(InputError):  # the toolkit's own layout has the names of these columns alone
                propose_offsets(how.using(offset_by=column).read(RSSI_FORMATS), findings)
        content = {
            "source": config.source,
            "kind": kind,
            "findings": [{"level": level, "text": text} for level, text in findings.sentences],
            "numbers": findings.numbers,
        }
        write_json(folder / "inspect.json", content)
        found = page(findings, kind, config, _kept(config, how, folder, out))
        write_page(folder, found)
    first, *_ = found.summary.conclusion
    steps = "\n".join(map(str, found.summary.next_steps))
    terminal.page(content, f"{config.source}: {kind}. {first}\n\n{findings}\n\n{steps}", out / "report.html")


def _kept(config: InspectConfig, how: Reading, folder: Path, out: Path) -> list[str]:
    """Write the options of reading of the command line beside the data, or else into the page's folder.

    Returns:
        Words of a command that reads the data with these options: none where it finds them beside the data.
    """
    if not config.reading.given:
        return [] if config.read is None else ["--read", config.read]
    text, file = yaml.safe_dump(config.reading.given, sort_keys=False), beside(Path(how.source))
    try:
        write_text(file, text)
    except OSError:  # of data that belong to others
        write_text(folder / READING, text)
        console.print(f"options of reading, for --read: {out / READING}")
        return ["--read", str(out / READING)]
    console.print(f"options of reading, which all commands find there: {file}")
    return []


def page(findings: Findings, kind: str, config: InspectConfig, read_as: Sequence[str] = ()) -> Page:
    """Return the page: findings and figures of what was read, and commands with the words that read it alike."""
    data, warnings = findings.data, findings.warnings
    rows = [[level, text] for level, text in findings.sentences]
    table = Table(["level", "finding"], rows, strong=frozenset(["warning"]), long=True)
    if isinstance(data, Rssi):
        position, task = data.transmitter_position, ["rssi"]
        plots = [_floor(data), *([_against_distance(data)] if data.located else [])]
    else:
        position, task = data.position, ["aoa", "--mix", "0.3"]
        plots = [_plan(data), _directions(data), *([_neighbours(data)] if len(data) > 1 else [])]
    extent = " x ".join(f"{side:.2f}" for side in (position.amax(dim=0) - position.amin(dim=0)).tolist())
    numbers = [
        Number(str(len(warnings)), "warning" if len(warnings) == 1 else "warnings"),
        Number(str(len(data)), f"measurements, read as {kind}"),
        Number(f"{extent} m", "extent of the positions, x by y by z"),
    ]
    again = NextStep("Correct the warnings and inspect again", command("inspect", config.source, *read_as))
    steps = [*([again] if warnings else []), NextStep("Go on", command(task[0], config.source, *task[1:], *read_as))]
    conclusion = ["Nothing looks wrong. Errors that the files alone do not reveal remain possible."]
    if warnings:
        conclusion = [
            f"{len(warnings)} {'warning' if len(warnings) == 1 else 'warnings'}: correct the data first.",
            *warnings,
        ]
    return Page(
        f"Inspection: {data.name}",
        Summary(numbers, plots[:1], conclusion, steps),
        [Section("Findings", tables=[table]), *([Section("Figures", plots=plots[1:])] if plots[1:] else [])],
    )


def _places(position: Tensor, **columns: Tensor) -> DataFrame:
    """Return a table with one row a position."""
    own = {name: values.numpy() for name, values in columns.items()}
    return DataFrame(position.numpy(), columns=["x_m", "y_m", "z_m"]).assign(**own)


def _plan(data: Spectra) -> Plot:
    marker, panels = "^" if data.moving == "transmitter" else "*", []
    extent = data.position.amax(dim=0) - data.position.amin(dim=0)
    for a, b in ((0, 1), (0, 2)):
        span = extent[[a, b]].clamp_min(1e-3)
        figure, ax = figures.panel(3.8, 0.6 + 3 * float((span[1] / span[0]).clamp(0.4, 1.2)))
        for free, colour in ((False, NONE), (True, DOTS)):
            place = data.position[data.line_of_sight == free]
            ax.plot(place[:, a], place[:, b], ".", markersize=3, color=colour)
        ax.set(xlabel=f"{'xyz'[a]} [m]", ylabel=f"{'xyz'[b]} [m]")
        ax.set_aspect("equal", adjustable="datalim")
        if data.fixed_position is not None:
            ax.plot(*data.fixed_position[[a, b]].tolist(), marker, color="black", markersize=7)
        if data.rotation is not None:  # at the array, or at the centre of the positions if it moves
            fixed = data.fixed_position if data.moving == "transmitter" else None
            origin = data.position.mean(dim=0) if fixed is None else fixed
            tips = 0.25 * float(extent.max() or 1.0) * data.rotation[[a, b]]
            start = origin[[a, b], None].expand(2, 3)
            ax.quiver(*start, *tips, color=AXES, angles="xy", scale_units="xy", scale=1, width=0.006)
        panels.append(figure)
    caption = (
        "From above and from the side: positions with (blue) and without line of sight (grey); arrows: the array's axes x "
        "(red), y (green) and its normal (blue)."
    )
    return Plot("plan", panels, caption, _places(data.position, line_of_sight=data.line_of_sight))


def _directions(data: Spectra) -> Plot:
    rows = data.line_of_sight.nonzero()[:MAX_DOTS, 0]
    peak = to_direction(*data.peak_direction(rows).unbind(-1))
    line = to_direction(*data.label[rows].unbind(-1))
    panels = []
    for title, direction in {"line of sight": line, "peak": peak}.items():
        figure, ax = figures.panel(3.6, 3.4)
        ax.scatter(direction[:, 0], direction[:, 1], s=6, c=data.label[rows, 0].rad2deg(), cmap="hsv", vmin=0, vmax=360)
        ax.add_patch(Circle((0, 0), 1, fill=False, color=figures.RULE))  # the array's horizon
        ax.set(xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), aspect="equal", title=title, xlabel="array x", ylabel="array y")
        panels.append(figure)
    apart = angular_distance(peak, line).rad2deg()
    figure, ax = figures.panel(3.8, 3.4)
    ax.hist(apart.numpy(), bins=45, range=(0, 90), color=DOTS)
    ax.set(xlabel="peak to line of sight [deg]", ylabel="spectra")
    azimuth, elevation = data.label[rows].rad2deg().unbind(-1)
    table = _places(data.position[rows], azimuth_deg=azimuth, elevation_deg=elevation, peak_from_line_deg=apart)
    caption = (
        "Lines of sight and peaks of the spectra as the array receives them, coloured by the azimuth of the line of "
        "sight: one picture where frames and calibration are right."
    )
    return Plot("directions", [*panels, figure], caption, table)


def _neighbours(data: Spectra) -> Plot:
    figure, ax = figures.panel(6, 3)
    apart = nearest(data.position, data.position, 2)[0][:, 1]
    low, high = (float(end) for end in apart.aminmax())  # all are equal on a regular grid, up to rounding
    ax.hist(apart.numpy(), bins=40, range=(low, max(high, low + MIN_BINS_M)), color=DOTS)
    if data.array is not None:
        ax.axvline(data.array.wavelength / 2, color="#cf4a4a")
    ax.set(xlabel="nearest other position [m]", ylabel="positions")
    caption = "Distance to the nearest other position."
    if data.array is not None:
        caption += " The line is half a wavelength."
    return Plot("neighbours", [figure], caption, _places(data.position, nearest_m=apart))


def _floor(data: Rssi) -> Plot:
    figure, ax = figures.panel(6.8, 4.8)
    data.plot(ax=ax).set_title("")
    places = zip(data.receiver_names, data.receiver_position, data.receiver_located, strict=True)
    for name, at, is_located in places:
        if is_located:
            ax.annotate(figures.short(name), at[:2].tolist(), fontsize=7, xytext=(3, 3), textcoords="offset points")
    caption = f"Positions, coloured by the strongest {data.quantity}; triangles: receivers, where they are known."
    strongest = data.rssi_dbm.nan_to_num(-torch.inf).amax(dim=1)
    return Plot("plan", [figure], caption, _places(data.transmitter_position, strongest_dbm=strongest))


def _against_distance(data: Rssi) -> Plot:
    figure, ax = figures.panel(6, 3.6)
    located = data.receiver_located
    log10, rssi = log_distance(data.transmitter_position, data.receiver_position[located]), data.rssi_dbm[:, located]
    ax.plot((10**log10).flatten(), rssi.flatten(), ".", markersize=2, color=DOTS, alpha=0.5)
    model, ends = fit_path_loss(log10, rssi, shared=True), torch.stack(log10[~rssi.isnan()].aminmax())
    ax.plot(10**ends, model.level + model.slope * ends, color="black", linewidth=1.5)
    ax.set(xlabel="distance from the receiver [m]", ylabel="RSSI [dBm]")
    figures.log_scale(ax)
    row, column = (~rssi.isnan()).nonzero(as_tuple=True)
    table = DataFrame(
        {
            "receiver": np.array(data.receiver_names)[located.numpy()][column.numpy()],
            "distance_m": (10 ** log10[row, column]).numpy(),
            "rssi_dbm": rssi[row, column].numpy(),
        }
    )
    caption = "RSSI against the distance from the receiver. The line is a path-loss model of all receivers."
    return Plot("path-loss", [figure], caption, table)


if __name__ == "__main__":
    raise SystemExit(run_module("tasks.inspect"))
