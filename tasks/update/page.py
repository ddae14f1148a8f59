"""The page of an update: error over time, what was surprising, and where the field changed."""

from __future__ import annotations

import math
from pathlib import Path

from pandas import DataFrame

from swiftwrf.positions import nearest
from tasks.answer import NextStep
from tasks.environment import command
from tasks.page import figures
from tasks.page.page import Number, Page, Plot, Section, Summary, Table
from tasks.records import MODEL
from tasks.update.record import WINDOW, Record

MAX_SURPRISING = 10
N_NEIGHBOURS = 5  # measurements whose mean innovation a map shows at each position
BLUE, RED = "#4477aa", "#ee6677"


def page(record: Record, name: str, folder: Path) -> Page:
    """Return the page of a record, with the name of its data, of an update in a directory."""
    numbers = [
        Number(str(len(record.rows)), "measurements learnt"),
        Number(f"{record.mean('error'):.3g}{record.unit}", "mean error before each was learnt"),
        Number(str(len(record.alarms)), "changes detected"),
    ]
    if math.isfinite(covered := record.mean("covered")):
        numbers.append(Number(f"{covered:.0%}", "of the values inside their 80 % interval"))
    step = NextStep(
        "Continue with the updated model", command("update", str(folder / MODEL), "SOURCE", "--out", "NEXT")
    )
    summary = Summary(numbers, [error_plot(record)], record.sentences(), [step])
    order = record.column("innovation").nan_to_num().argsort(descending=True)[:MAX_SURPRISING].tolist()
    cells = [
        [
            str(record.rows[i]["index"]),
            *(f"{record.rows[i][key]:.3g}" for key in ("x_m", "y_m", "z_m", "error", "innovation")),
        ]
        for i in order
    ]
    columns = ["measurement", "x [m]", "y [m]", "z [m]", f"error{record.unit}", "innovation"]
    table = Table(columns, cells, "Measurements with the largest innovations.")
    return Page(f"Update: {name}", summary, [Section("Surprising measurements", [], [table], [map_plot(record)])])


def error_plot(record: Record) -> Plot:
    """Return the errors over time, and the alarms."""
    figure, axes = figures.panel(7.4, 3.2)
    error, running = record.column("error"), record.column("running_error")
    axes.plot(error, ".", markersize=3, color=figures.RULE)
    axes.plot(running, color=BLUE)
    for number, _ in record.alarms:
        axes.axvline(number, color=RED, linewidth=1)
    axes.set(xlabel="measurement", ylabel=f"error{record.unit}", ylim=(0, None))
    caption = f"Error of each measurement before it was learnt, mean of the last {WINDOW} (blue), and alarms (red)."
    return Plot("error", [figure], caption, DataFrame({"error": error, "running_error": running}))


def map_plot(record: Record) -> Plot:
    """Return the positions from above with their innovations."""
    figure, axes = figures.panel(6.8, 5)
    position = record.column("x_m", "y_m", "z_m")
    _, near = nearest(position, position, min(N_NEIGHBOURS, len(position)))
    surprise = record.column("innovation")[near].nanmean(dim=1)
    drawn = axes.scatter(position[:, 0], position[:, 1], s=10, c=surprise, cmap="viridis", vmin=0)
    figures.colour_bar(axes, drawn, f"mean innovation of the {N_NEIGHBOURS} nearest measurements")
    caption = "Positions from above, coloured by their innovations."
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    table = DataFrame(position.numpy(), columns=["x_m", "y_m", "z_m"]).assign(innovation=surprise.numpy())
    return Plot("changes", [figure], caption, table)
