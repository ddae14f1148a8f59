"""Poses of a next array: their files, and their section of the report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pandas import DataFrame
from torch import Tensor

from augment.placement import StationSuggestion
from swiftwrf.runtime.durable import write_npz
from tasks import labels
from tasks.page import figures
from tasks.page.page import Plot, Section, Table
from tasks.page.shared import MAX_NUMBERED, MEASURED, NEXT
from tasks.records import write_table

ARROW_M = 0.4  # length of the arrow along which an array faces, in plan


def write_poses(file: Path, measured: Tensor, found: StationSuggestion) -> None:
    """Write suggested poses as a table, and as arrays for the report, in files of one name.

    The quaternion of a pose is that of `array_orientation` in files of snapshots.
    """
    position = np.array([pose.position for pose in found.pose])
    arrays = {"measured": measured.numpy(), "stations": found.position.numpy(), "position": position}
    arrays |= {name: getattr(found, name).numpy() for name in ("normal", "error_m", "gain_m", "gain_std_m")}
    table = _table(arrays).assign(
        **{f"orientation_{axis}": [pose.orientation[i] for pose in found.pose] for i, axis in enumerate("xyzw")}
    )
    write_table(file.with_name(f"{file.name}.csv"), table.to_dict("records"))
    write_npz(file.with_name(f"{file.name}.npz"), arrays)


def _table(arrays: Mapping[str, NDArray[Any]]) -> DataFrame:
    columns = {f"{axis}_m": arrays["position"][:, i] for i, axis in enumerate("xyz")}
    columns |= {f"facing_{axis}": arrays["normal"][:, i] for i, axis in enumerate("xyz")}
    return DataFrame(
        columns | {"expected_error_m": arrays["error_m"]} | {k: arrays[k] for k in ("gain_m", "gain_std_m")}
    )


def poses_section(arrays: Mapping[str, NDArray[Any]], table: str, name: str) -> Section | None:
    """Return a plan and a table of suggested poses, from arrays of `write_poses`. None without any."""
    if not arrays:
        return None
    position, normal, gain, std = (arrays[key] for key in ("position", "normal", "gain_m", "gain_std_m"))
    figure, plan = figures.panel(5, 4.2)
    plan.plot(*arrays["measured"][:, :2].T, ".", color=MEASURED, markersize=3, label="measured")
    plan.plot(*arrays["stations"][:, :2].T, "^", color=labels.colour(labels.LOCALIZERS, "posterior"), label="arrays")
    plan.plot(*position[:, :2].T, "D", color=NEXT, markersize=5, label="suggested")
    plan.quiver(
        *position[:, :2].T,
        *ARROW_M * normal[:, :2].T,
        color=NEXT,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.004,
    )
    for rank, (x, y) in enumerate(position[:MAX_NUMBERED, :2], start=1):
        plan.annotate(str(rank), (x, y), xytext=(4, 4), textcoords="offset points", fontsize=7)
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figures.legend_below(plan)
    before = float(arrays["error_m"][0] + gain[0])
    text = (
        f"A further array in the first of these poses ({table}.csv) would lower the expected median position error by "
        f"{gain[0]:.3f} m (standard error {std[0]:.3f} m) from {before:.3f} m. Spectra are simulated by the rooms found, "
        "and what was measured at positions is left out. Expected errors therefore compare poses, and are larger than the "
        "errors above."
    )
    rows = [
        [str(rank), *(f"{x:.2f}" for x in (*at, *facing)), f"{error:.3f}", f"{lower:.3f}", f"{spread:.3f}"]
        for rank, (at, facing, error, lower, spread) in enumerate(
            zip(position, normal, arrays["error_m"], gain, std, strict=True), start=1
        )
    ]
    heads = ["rank", *(f"{axis} [m]" for axis in "xyz"), *(f"facing {axis}" for axis in "xyz")]
    heads += ["expected error [m]", "gain [m]", "standard error [m]"]
    caption = "Suggested poses of a further array in plan, numbered by rank. Arrows show where they face."
    plot = Plot(f"suggested-{name}", [figure], caption, _table(arrays))
    return Section("Where the next array belongs", [text], plots=[plot], tables=[Table(heads, rows)])
