"""Plans of access points by a run of `rssi`: an answer, a report and the candidates as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pandas import DataFrame
from torch import Tensor

from swiftwrf import InputError, Rssi, RssiModel, load
from swiftwrf.contrib.comparison.steps import MODEL
from swiftwrf.contrib.survey.plan import WORTH, CoveragePlan, interval, plan_coverage
from swiftwrf.data.coordinates import PlanFrame
from swiftwrf.data.receivers import read_places
from swiftwrf.metrics import LEVEL
from swiftwrf.runtime.durable import write_json
from tasks.command import run_module
from tasks.configs import PlanConfig
from tasks.directory import new_directory
from tasks.environment import command, stamp
from tasks.page import figures
from tasks.page.page import REPORT, Number, Page, Plot, Section, Summary, Table, write_page
from tasks.page.shared import MEASURED, NEXT
from tasks.records import RECEIVERS, Records, Row, rounded, write_table
from tasks.terminal import NextStep, terminal

CANDIDATES = "candidates"  # name of the table
MAX_SHOWN = 10  # candidates in the report; all are in the table


def run(config: PlanConfig) -> None:
    """Print what further access points and changes do to the coverage, and write a table, a report and plan.json.

    Raises:
        InputError: No run of `rssi`, or access points that it does not contain.
    """
    records = Records(Path(config.run))
    model, survey = survey_of(records)
    threshold = config.above
    if threshold is None:
        threshold = float(records.metrics["coverage"][0]["threshold_dbm"])
    places = None
    if config.at is not None:
        places = read_places(Path(config.at), model.origin, PlanFrame(), survey.floors)
    out = Path(config.out) if config.out else Path("runs") / "plan" / stamp()
    with new_directory(out, "a plan") as folder:
        found = plan_coverage(
            model,
            survey,
            config.aps,
            above_dbm=threshold,
            candidates=places,
            off=config.off,
            power_db=config.power_db,
            seed=config.seed,
        )
        write_table(folder / f"{CANDIDATES}.csv", rounded(found.to_frame().to_dict("records")))
        content = values(found, config)
        write_json(folder / "plan.json", content)
        write_page(folder, page(found, config, records))
    steps = map(_line, content["steps"])
    lines = [
        *content["conclusion"],
        "",
        *steps,
        "",
        *map(str, next_steps(config)),
        f"candidates: {out / CANDIDATES}.csv",
    ]
    terminal.page(content, "\n".join(lines), out / REPORT)


def survey_of(records: Records) -> tuple[RssiModel, Rssi]:
    """Return model and training rows of a run of `rssi`, with estimated positions where none are known.

    Raises:
        InputError: A run of another task, or with receivers that move.
    """
    maps, file = records.arrays("maps"), records.folder / MODEL
    if records.config.get("task") != "rssi" or not maps or not file.is_file():
        raise InputError(f"{records.folder} is no run of swiftwrf rssi; run {command('rssi', '--rx', 'all')} first")
    model = load(file)
    if records.metrics["unit"] != "dBm":
        raise InputError(f"{records.folder} is a run of {records.metrics['quantity']}; a plan needs a run of RSSI")
    if not isinstance(model, RssiModel):
        raise InputError(f"{records.folder} has receivers that move; a plan is for access points at fixed places")
    receiver = model.receiver_position.clone()
    if estimated := records.arrays(RECEIVERS):
        numbers = [model.receiver_names.index(str(name)) for name in estimated["names"]]
        receiver[numbers] = torch.from_numpy(estimated["position"])
    survey = Rssi(
        maps["measured"],
        maps["measured_position"],
        receiver_position=receiver,
        receiver_names=model.receiver_names,
        origin=model.origin,
        floors=None if model.attenuation is None else model.attenuation.floors,
        name=str(records.metrics["data"]),
    )
    return model, survey


def values(found: CoveragePlan, config: PlanConfig) -> Row:
    """Return the content of plan.json: coverage of each step with its interval, the chosen places, and sentences."""
    steps: list[Row] = [_step("as surveyed", found.measured)]
    changes = [*(f"{name} off" for name in config.off), *(f"{name} {db:+g} dB" for name, db in config.power_db.items())]
    if changes:
        steps.append(_step(", ".join(changes), found.before, found.measured))
    last = found.before
    for number, after in zip(found.chosen, found.after, strict=True):
        x, y, z = found.candidates[number].tolist()
        steps.append(_step(f"access point at ({x:.1f}, {y:.1f}, {z:.1f}) m", after, last) | {"position_m": [x, y, z]})
        last = after
    return {"threshold_dbm": found.threshold_dbm, "steps": steps, "conclusion": conclusion(steps, found)}


def _step(name: str, samples: Tensor, before: Tensor | None = None) -> Row:
    """Return a step: its coverage and its gain over the samples before, each with the interval."""
    step: Row = {"step": name}
    for kind, of in (("coverage", samples), ("gain", None if before is None else samples - before)):
        if of is not None:
            step |= dict(zip((kind, f"{kind}_low", f"{kind}_high"), map(float, interval(of)), strict=True))
    return step


def _line(step: Row) -> str:
    """Return a step in words."""
    text, gain = f"{step['step']}: coverage {_coverage(step)}", _gain(step)
    return f"{text}, {gain} points" if gain else text


def _coverage(step: Row) -> str:
    """Return the coverage of a step with its interval."""
    return f"{step['coverage']:.0%} ({step['coverage_low']:.0%} to {step['coverage_high']:.0%})"


def _gain(step: Row) -> str:
    """Return the gain of a step with its interval [points]; empty for the first one."""
    if "gain" not in step:
        return ""
    return f"{_points(step['gain'])} ({_points(step['gain_low'])} to {_points(step['gain_high'])})"


def _points(share: float) -> str:
    return f"{100 * share:+.1f}"


def conclusion(steps: Sequence[Row], found: CoveragePlan) -> list[str]:
    """Return in sentences what the changes do to the coverage."""
    first, last = steps[0], steps[-1]
    said = (
        f"{first['coverage']:.0%} of the scans in the measured area have a receiver above {found.threshold_dbm:g} dBm; "
        f"after all changes it would be {last['coverage']:.0%} ({LEVEL:.0%} interval {last['coverage_low']:.0%} to "
        f"{last['coverage_high']:.0%})."
    )
    poor = [step for step in steps if "position_m" in step and step["gain"] < WORTH]
    if poor:
        return [
            said,
            f"An access point that adds less than {100 * WORTH:.0f} points is not worth it: {len(poor)} of them.",
        ]
    return [said]


def next_steps(config: PlanConfig) -> list[NextStep]:
    """Return what to do next."""
    return [
        NextStep("Compare your own places", command("plan", config.run, "--at", "places.csv")),
        NextStep("Measure after the change, since the interval is that of a place where no access point hung yet"),
    ]


def page(found: CoveragePlan, config: PlanConfig, records: Records) -> Page:
    """Return the report: coverage before and after in plan, and tables of the steps and of the best candidates."""
    content = values(found, config)
    first, last = content["steps"][0], content["steps"][-1]
    rows = [[step["step"], _coverage(step), _gain(step)] for step in content["steps"]]
    caption = (
        f"Expected share of scans above {found.threshold_dbm:g} dBm in the measured area, with {LEVEL:.0%} intervals."
    )
    steps = Table(["step", "coverage", "gain [points]"], rows, caption)
    table = found.to_frame()
    best = [
        [
            *(f"{row[f'{axis}_m']:.1f}" for axis in "xyz"),
            *(_points(row[key]) for key in ("gain", "gain_low", "gain_high")),
        ]
        for row in table.head(MAX_SHOWN).to_dict("records")
    ]
    heads = [*(f"{axis} [m]" for axis in "xyz"), "gain [points]", "from", "to"]
    compared = Table(heads, best, f"The best {len(best)} of {len(table)} candidates, each alone.")
    numbers = [
        Number(f"{first['coverage']:.0%}", "coverage as surveyed"),
        Number(f"{last['coverage']:.0%}", "coverage after all changes"),
    ]
    text = (
        "A further access point has level and slope of the path loss of those surveyed, with their spread, and shadowing of "
        "the correlation that the survey shows. Walls that nobody measured are in the interval and not in the mean."
    )
    limits = (
        "Coverage is that of the measured area. Interference, load and the power of the clients are not part of it."
    )
    sections = [Section("Candidates", [text], [steps, compared]), Section("What this does not show", [limits])]
    summary = Summary(numbers, _maps(found), content["conclusion"], next_steps(config))
    return Page(f"Plan: {records.place}", summary, sections)


def _maps(found: CoveragePlan) -> list[Plot]:
    """Return the probability of a receiver above the threshold before and after all changes, in plan, by floor."""
    floors = found.survey.floors
    number = torch.zeros(len(found.cells)).long() if floors is None else floors.number(found.cells)
    chosen = found.candidates[list(found.chosen)]
    floor_of = torch.zeros(len(chosen)).long() if floors is None or not len(chosen) else floors.number(chosen)
    plots = []
    for floor in number.unique().tolist():
        here, name = number == floor, "" if floors is None else floors.names[floor]
        at = found.cells[here].numpy()
        mine = {rank: chosen[rank - 1].tolist() for rank, own in enumerate(floor_of.tolist(), start=1) if own == floor}
        panels = []
        for title, values_of in zip(("before", "after"), found.probability[:, here].numpy(), strict=True):
            added = mine if title == "after" else {}
            panels.append(_panel(found.survey, at, values_of, f"{title} {name}".strip(), added))
        data = DataFrame(at.round(3), columns=["x_m", "y_m", "z_m"])
        before, after = found.probability[:, here].numpy().round(4)
        caption = (
            f"Probability that a scan has a receiver above {found.threshold_dbm:g} dBm, before and after all changes. "
            "Triangles: receivers of known or estimated position; numbered crosses: further access points in their order."
        )
        data = data.assign(before=before, after=after)
        plots.append(Plot(f"plan-{floor}", panels, caption, data))
    return plots


def _panel(
    survey: Rssi,
    at: NDArray[np.float64],
    probability: NDArray[np.float64],
    title: str,
    added: Mapping[int, list[float]],
) -> Figure:
    """Draw the probability (n,) in cells (n, 3) [m], receivers, and places (3,) [m] of access points by their number."""
    sides = np.ptp(at[:, :2], axis=0)
    figure, plan = figures.panel(4.6, 0.8 + 3.4 * float(np.clip(sides[1] / max(sides[0], 1e-9), 0.4, 1.6)))
    x, y = at[:, :2].T
    drawn = plan.scatter(x, y, c=probability, s=9, marker="s", cmap="viridis", vmin=0, vmax=1, rasterized=True)
    plan.plot(*survey.receiver_position[survey.receiver_located][:, :2].numpy().T, "^", color=MEASURED, markersize=6)
    for rank, (x_m, y_m, _) in added.items():
        plan.plot(x_m, y_m, "X", color=NEXT, markersize=9)
        plan.annotate(str(rank), (x_m, y_m), xytext=(5, 5), textcoords="offset points", fontsize=8)
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    plan.set_title(title, fontsize=9)
    figures.colour_bar(plan, drawn, "probability")
    return figure


if __name__ == "__main__":
    raise SystemExit(run_module("tasks.plan"))
