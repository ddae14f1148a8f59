"""The page of a scene: the room in plan and in space, and the paths of one position."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from numpy.typing import NDArray
from pandas import DataFrame
from torch import Tensor

from swiftwrf.array.angles import to_angles
from swiftwrf.choices import Moving
from swiftwrf.data.paths import PropagationPaths
from swiftwrf.data.raytraced import Surface
from tasks.page import figures
from tasks.page.page import Number, Page, Plot, Section, Summary, Table

FIXED, MOVING, EDGE = "#cc3311", "#4477aa", "#7a8494"
ORDERS = (
    "#222222",
    "#0077bb",
    "#009988",
    "#ee7733",
    "#aa4499",
)  # of paths by their interactions; the last one and more
MATERIALS = {  # any other is grey
    "carpet_tile": "#88aa55",
    "chipboard": "#ddaa33",
    "glass": "#66ccee",
    "metal": "#555555",
    "wood": "#aa7744",
}
OTHER = "#999999"
MAX_PATHS = 25  # of one position that are drawn
MAX_DOTS = 1000
FLAT_COSINE = 0.999  # between normals of faces that form one plane
ENCLOSING_EXTENT = 0.95  # of the scene: a surface from that size on is drawn as outline only


def page(name: str, surfaces: list[Surface], moving: Moving, paths: PropagationPaths) -> Page:
    """Return the page: the room, both ends, and the paths of the position nearest to the centre of all."""
    ends = (paths.transmitter, paths.receiver)
    position, fixed = ends if moving == "transmitter" else ends[::-1]
    sight = f"{float(paths.line_of_sight.double().mean()):.0%}"
    numbers = [
        Number(str(len(position)), f"positions of the {moving}, {sight} of them with line of sight"),
        Number(f"{float(paths.count.double().mean()):.0f}", "paths to a position, mean"),
        Number(f"{float(paths.power_db.median()):.0f} dB", "power of all paths to a position, median of the positions"),
    ]
    other = "receiver" if moving == "transmitter" else "transmitter"
    meaning = [
        f"Ray paths between a moving {moving} and a fixed {other}, traced by Sionna RT. Both ends are isotropic and "
        "vertically polarised; obstacles block without transmission."
    ]
    steps = [
        "Go on with `python -m tasks.aoa --mix 0.3 --data DIR`, where DIR is this directory. The array lies level at the "
        "receiver."
    ]
    summary = Summary(numbers, [_room(surfaces, fixed[0], position, moving, paths)], meaning, steps)
    materials = sorted({(s.material.name, s.material.thickness_m) for s in surfaces})
    rows = [[material, f"{1e3 * thickness:g}"] for material, thickness in materials]
    table = Table(["material", "thickness [mm]"], rows, "Materials of the surfaces.")
    middle = int((position - position.mean(dim=0)).norm(dim=1).argmin())
    rays = _rays(surfaces, fixed[0], position[middle], paths, middle, moving)
    return Page(
        f"Scene: {name}", summary, [Section("One position", plots=[rays]), Section("Materials", tables=[table])]
    )


def _room(surfaces: list[Surface], fixed: Tensor, position: Tensor, moving: Moving, paths: PropagationPaths) -> Plot:
    figure, plan, space = _drawing(surfaces)
    dots = position[:MAX_DOTS]
    plan.plot(*dots[:, :2].T, ".", color=MOVING, markersize=2.5, label=f"moving {moving}")
    space.scatter(*dots.T, s=2, color=MOVING, depthshade=False)
    _mark(plan, space, fixed, "*", FIXED, "fixed end")
    figures.legend_below(figure, plan)
    table = DataFrame(position.numpy(), columns=["x_m", "y_m", "z_m"]).assign(
        line_of_sight=paths.line_of_sight.numpy(), paths=paths.count.numpy(), power_db=paths.power_db.numpy()
    )
    return Plot("room", [figure], "In plan and in space: surfaces, positions (blue), the fixed end (star).", table)


def _rays(
    surfaces: list[Surface], fixed: Tensor, place: Tensor, paths: PropagationPaths, number: int, moving: Moving
) -> Plot:
    assert paths.corner is not None
    assert paths.length is not None
    figure, plan, space = _drawing(surfaces)
    own = (paths.owner == number).nonzero()[:, 0]
    own = own[paths.gain[own].abs().argsort()[-MAX_PATHS:]]  # the strongest on top
    start, end = paths.transmitter[number], paths.receiver[number]
    level = 20 * paths.gain[own].abs().log10().numpy()
    width = 0.3 + 1.9 * Normalize(level.min(), max(level.max(), level.min() + 1), clip=True)(level)
    order = paths.order[own].clamp(max=len(ORDERS) - 1).tolist()
    lines = []
    for row in own.tolist():
        corner = paths.corner[row]
        lines.append(torch.cat([start[None], corner[corner[:, 0].isfinite()], end[None]]).numpy())
    style: dict[str, Any] = {"colors": [ORDERS[k] for k in order], "linewidths": width, "alpha": 0.8}
    plan.add_collection(LineCollection([line[:, :2] for line in lines], zorder=3, **style))
    space.add_collection3d(Line3DCollection(lines, **style))
    _mark(plan, space, fixed, "*", FIXED, "fixed end")
    _mark(plan, space, place, "o", MOVING, f"moving {moving}")
    named = {0: "direct", 1: "1 interaction", len(ORDERS) - 1: f"{len(ORDERS) - 1} and more"}
    entries = [Line2D([], [], color=ORDERS[k], label=named.get(k, f"{k} interactions")) for k in sorted(set(order))]
    figure.legend(handles=[*entries, *plan.lines], loc="outside lower center", ncols=6, frameon=False)
    caption = (
        f"The strongest paths (at most {MAX_PATHS}) of the position nearest to the middle of all, coloured by their number "
        "of reflections and other interactions; thick lines are strong. The angles are those of arrival at the receiver."
    )
    azimuth, elevation = (angle.rad2deg() for angle in to_angles(paths.direction[own]))
    table = DataFrame(
        {
            "length_m": paths.length[own].numpy(),
            "gain_db": level,
            "interactions": paths.order[own].numpy(),
            "azimuth_deg": azimuth.numpy(),
            "elevation_deg": elevation.numpy() * paths.direction[own, 2].sign().numpy(),
        }
    )
    return Plot("rays", [figure], caption, table[::-1])


def _mark(plan: Axes, space: Any, at: Tensor, marker: str, colour: str, label: str) -> None:
    """Mark a position in plan and in space."""
    size = 12 if marker == "*" else 7
    plan.plot(*at[:2], marker, color=colour, markersize=size, zorder=4, label=label, linestyle="")
    space.scatter(*at, s=80 if marker == "*" else 40, marker=marker, color=colour, depthshade=False)


def _drawing(surfaces: list[Surface]) -> tuple[Figure, Axes, Any]:
    """Return a plan and a view in space, with furniture filled and surfaces that enclose the scene as outline."""
    figure, (plan, corner) = figures.new_figure(1, 2, 12, 5)
    space = figures.in_space(figure, corner)
    every = np.concatenate([surface.vertex for surface in surfaces])
    low, high = every.min(axis=0), every.max(axis=0)
    for surface in surfaces:
        edges, colour = outline(surface), MATERIALS.get(surface.material.name, OTHER)
        encloses = bool((np.ptp(surface.vertex, axis=0)[:2] > ENCLOSING_EXTENT * (high - low)[:2]).all())
        plan.add_collection(
            LineCollection(
                list(edges[..., :2]), colors="black" if encloses else colour, linewidths=1.0 if encloses else 0.6
            )
        )
        space.add_collection3d(Line3DCollection(list(edges), colors=EDGE if encloses else colour, linewidths=0.5))
        if not encloses:
            faces = surface.vertex[surface.triangle]
            plan.add_collection(PolyCollection(list(faces[..., :2]), facecolors=colour, edgecolors="none", alpha=0.12))
            space.add_collection3d(Poly3DCollection(list(faces), facecolors=colour, edgecolors="none", alpha=0.15))
    margin = 0.03 * float((high - low).max())
    for set_limits, axis in ((plan.set_xlim, 0), (plan.set_ylim, 1)):
        set_limits(low[axis] - margin, high[axis] + margin)
    plan.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    space.set(
        xlabel="x [m]",
        ylabel="y [m]",
        zlabel="z [m]",
        xlim=(low[0], high[0]),
        ylim=(low[1], high[1]),
        zlim=(low[2], high[2]),
    )
    space.set_box_aspect(np.maximum(high - low, 0.1 * (high - low).max()))
    names = list(dict.fromkeys(s.material.name for s in surfaces if s.name.startswith("furniture")))
    if names:
        handles = [Line2D([], [], color=MATERIALS.get(n, OTHER), linewidth=4, alpha=0.6, label=n) for n in names]
        below: dict[str, Any] = {
            "loc": "upper left",
            "bbox_to_anchor": (0, -0.12),
            "ncols": len(names),
            "frameon": False,
        }
        plan.legend(handles=handles, fontsize=7, **below)
    return figure, plan, space


def outline(surface: Surface) -> NDArray[Any]:
    """Return the segments (E, 2, 3) [m] at which faces meet at an angle or end, for a drawing."""
    corner = surface.vertex[surface.triangle]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    sides: dict[tuple[int, int], list[int]] = {}
    for number, (a, b, c) in enumerate(surface.triangle.tolist()):
        for side in ((a, b), (b, c), (c, a)):
            sides.setdefault((min(side), max(side)), []).append(number)
    kept = [
        side
        for side, (first, *others) in sides.items()
        if not others or min(abs(normal[first] @ normal[other]) for other in others) < FLAT_COSINE
    ]
    return surface.vertex[np.array(kept, dtype=np.int64).reshape(-1, 2)]
