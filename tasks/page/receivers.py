"""Estimated positions of receivers: their files in a run, and their section of the report."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.patches import Circle
from pandas import DataFrame

from swiftwrf import InputError, Rssi
from swiftwrf.contrib.comparison.base import Recorded
from swiftwrf.contrib.survey.receivers import locate_receivers
from tasks.page import figures
from tasks.page.page import Plot, Section, Table
from tasks.page.shared import MEASURED, NEXT
from tasks.records import RECEIVERS, Records

MAX_ESTIMATED = 60  # most often detected receivers whose positions a run estimates, which takes half a second each
MAX_NAMED = 30  # receivers with their name in the figure; more would hide each other
BAND = 0.35  # width of the part of the figure beside the rows, relative to their extent


def with_receivers(recorded: Recorded, data: Rssi) -> Recorded:
    """Return a recorded result with the positions of the receivers of unknown position, estimated from its RSSI."""
    if not data.is_power:
        return recorded
    often = data.detected.sum(dim=0).where(~data.receiver_located, 0).argsort(descending=True, stable=True)
    kept = data.receiver_located.clone()
    kept[often[:MAX_ESTIMATED]] = True
    try:
        found = locate_receivers(data.columns(kept.nonzero()[:, 0].tolist()))
    except InputError:  # nothing to estimate, or not enough rows
        return recorded
    table = found.to_frame()
    fields = ("position", "radius_m", "outside", "strongest", "centroid")
    arrays = {name: getattr(found, name).numpy() for name in fields} | {"measured": data.transmitter_position.numpy()}
    rows = zip(
        found.names, *(getattr(found, name).tolist() for name in ("position", "radius_m", "outside")), strict=True
    )
    positions = [
        {"receiver": name, "position_m": at, "radius_80_m": radius, "outside": outside}
        for name, at, radius, outside in rows
    ]
    return replace(
        recorded,
        metrics=recorded.metrics | {"receiver_positions": positions},
        tables={**recorded.tables, RECEIVERS: table},
        arrays={**recorded.arrays, RECEIVERS: arrays | {"names": np.array(found.names)}},
    )


def receivers_sentence(run: Records) -> list[str]:
    """Return how many positions of receivers were estimated and how well, a sentence; nothing without any."""
    found = run.metrics.get("receiver_positions", [])
    if not found:
        return []
    radius = float(np.median([one["radius_80_m"] for one in found]))
    outside = sum(one["outside"] > 0.5 for one in found)
    what = f"Positions of {len(found)} receivers" if len(found) > 1 else "The position of one receiver"
    were = "were" if len(found) > 1 else "was"
    where = f"; {outside} {'is' if outside == 1 else 'are'} outside of what was walked" if outside else ""
    return [f"{what} {were} unknown and estimated, within {radius:.1f} m with 80 % probability (median){where}."]


def receivers_section(run: Records) -> Section | None:
    """Return a plan and a table of the estimated positions of receivers; None without any."""
    arrays = run.arrays(RECEIVERS)
    if not arrays:
        return None
    position, radius, outside, strongest = (arrays[name] for name in ("position", "radius_m", "outside", "strongest"))
    names, measured = [str(name) for name in arrays["names"]], arrays["measured"][:, :2]
    low, high = measured.min(axis=0), measured.max(axis=0)
    band = BAND * float((high - low).max())
    sides = high - low + 2 * band
    figure, plan = figures.panel(6.0, 0.8 + 4.8 * float(np.clip(sides[1] / sides[0], 0.4, 1.4)))
    many = len(measured) >= figures.MAX_VECTOR_MARKS
    plan.plot(*measured.T, ".", color=MEASURED, markersize=2, label="measured", rasterized=many)
    for at, each, out in zip(position, radius, outside, strict=True):
        style = "--" if out > 0.5 else "-"
        plan.add_patch(Circle(at[:2], each, fill=False, color=NEXT, linewidth=0.8, linestyle=style))
    plan.plot(*position[:, :2].T, "x", color=NEXT, markersize=7, markeredgewidth=2, label="estimated receiver")
    for name, at in list(zip(names, position, strict=True))[: MAX_NAMED if len(names) <= MAX_NAMED else 0]:
        plan.annotate(figures.short(name), at[:2], xytext=(4, 4), textcoords="offset points", fontsize=figures.LABEL)
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    plan.set(xlim=(low[0] - band, high[0] + band), ylim=(low[1] - band, high[1] + band))
    figures.legend_below(plan)
    data = DataFrame(position.round(2), columns=["x_m", "y_m", "z_m"]).assign(radius_80_m=radius, outside=outside)
    data.insert(0, "receiver", names)
    rows = [
        [name, *(f"{x:.2f}" for x in at), f"{each:.1f}", "yes" if out > 0.5 else "no", *(f"{x:.2f}" for x in peak[:2])]
        for name, at, each, out, peak in zip(names, position, radius, outside, strongest, strict=True)
    ]
    heads = ["receiver", *(f"{axis} [m]" for axis in "xyz"), "80 % radius [m]", "outside of what was walked"]
    heads += ["x of the strongest row [m]", "y of it [m]"]
    text = (
        f"The survey does not state the positions of receivers ({len(names)}). Each is estimated from its own RSSI and lies "
        f"in its circle with 80 % probability. `{RECEIVERS}.csv` beside the survey gives the positions back: correct those "
        f"that you know first. Heights are hardly determined. At most {MAX_ESTIMATED} receivers are estimated, those "
        "detected most often."
    )
    caption = (
        "Estimated positions of the receivers in plan. A circle contains the receiver with 80 % probability; it is dashed "
        "where the receiver is more probably outside of what was walked."
    )
    return Section("", [text], [Table(heads, rows)], [Plot(f"receivers-{run.file_name}", [figure], caption, data)])
