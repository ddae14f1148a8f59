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
from torch import Tensor

from swiftwrf.data.raytraced import Scene, Surface, TracedPaths, outline
from swiftwrf.data.spectra import Moving
from tasks.page import figures
from tasks.page.page import Page, Plot, Section, Table

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
STRONGEST = 25  # paths of one position that are drawn
MOST_DOTS = 1000
ENCLOSING = 0.95  # of the scene's extent: a surface that is as large encloses it and is drawn as outline only


def page(name: str, scene: Scene, fixed: Tensor, position: Tensor, moving: Moving, paths: TracedPaths) -> Page:
    """The room, where the ends are, and the paths of the position in the middle of the others."""
    materials = sorted({(s.material.name, s.material.thickness_m) for s in scene.surfaces})
    power = (
        10
        * torch.zeros(len(paths.count), dtype=torch.float64)
        .index_add(0, paths.owner, paths.gain.abs().square())
        .log10()
    )
    rows = [
        ["positions", str(len(position))],
        ["with line of sight", f"{float(paths.line_of_sight.double().mean()):.0%}"],
        ["paths a position, mean", f"{float(paths.count.double().mean()):.0f}"],
        ["power of all paths, median [dB]", f"{float(power.median()):.1f}"],
        ["longest path [m]", f"{float(paths.length.max()):.1f}"],
        ["materials", ", ".join(f"{material} {1e3 * thick:g} mm" for material, thick in materials)],
    ]
    middle = int((position - position.mean(dim=0)).norm(dim=1).argmin())
    other = "receiver" if moving == "transmitter" else "transmitter"
    lead = f"Ray paths between {len(position)} positions of a {moving} and a {other} that stays, traced by Sionna RT."
    return Page(
        f"Scene: {name}",
        lead,
        [
            Section("What it holds", tables=[Table(["", ""], rows)]),
            Section(
                "The room",
                plots=[
                    Plot(
                        "room",
                        _room(scene, fixed, position, moving),
                        "In plan and in space: surfaces, positions (blue), the end that stays (star).",
                    )
                ],
            ),
            Section(
                "One position",
                plots=[
                    Plot(
                        "rays",
                        _rays(scene, fixed, position[middle], paths, middle, moving),
                        f"The strongest paths (at most {STRONGEST}) of the position nearest to the middle of all, coloured "
                        "by their number of reflections and other interactions; thick lines are strong.",
                    )
                ],
            ),
        ],
    )


def _room(scene: Scene, fixed: Tensor, position: Tensor, moving: Moving) -> Figure:
    figure, plan, space = _pair()
    _draw(scene.surfaces, plan, space)
    dots = position[:MOST_DOTS]
    plan.plot(*dots[:, :2].T, ".", color=MOVING, markersize=2.5, label=f"{moving}, moves")
    plan.plot(*fixed[:2], "*", color=FIXED, markersize=12, label="end that stays", linestyle="")
    space.scatter(*dots.T, s=2, color=MOVING, depthshade=False)
    space.scatter(*fixed, s=80, marker="*", color=FIXED, depthshade=False)
    figures.legend_below(figure, plan)
    return figure


def _rays(scene: Scene, fixed: Tensor, place: Tensor, paths: TracedPaths, number: int, moving: Moving) -> Figure:
    figure, plan, space = _pair()
    _draw(scene.surfaces, plan, space)
    own = (paths.owner == number).nonzero()[:, 0]
    own = own[paths.gain[own].abs().argsort()[-STRONGEST:]]  # the strongest on top
    start, end = (fixed, place) if moving == "receiver" else (place, fixed)
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
    for at, marker, colour in ((fixed, "*", FIXED), (place, "o", MOVING)):
        plan.plot(*at[:2], marker, color=colour, markersize=12 if marker == "*" else 7, zorder=4)
        space.scatter(*at, s=80 if marker == "*" else 40, marker=marker, color=colour, depthshade=False)
    named = {0: "direct", 1: "1 interaction", len(ORDERS) - 1: f"{len(ORDERS) - 1} and more"}
    entries = [Line2D([], [], color=ORDERS[k], label=named.get(k, f"{k} interactions")) for k in sorted(set(order))]
    entries += [
        Line2D([], [], color=FIXED, marker="*", markersize=10, linestyle="", label="end that stays"),
        Line2D([], [], color=MOVING, marker="o", linestyle="", label=f"{moving}, moves"),
    ]
    figure.legend(handles=entries, loc="outside lower center", ncols=6, frameon=False)
    return figure


def _pair() -> tuple[Figure, Axes, Any]:
    """Axes of a plan and of a view in space."""
    figure, axes = figures.new_figure(1, 2, 11, 5)
    axes[1].remove()
    return figure, axes[0], figure.add_subplot(1, 2, 2, projection="3d")


def _draw(surfaces: list[Surface], plan: Axes, space: Any) -> None:
    """What stands in the room, filled; what encloses it, as outline."""
    every = np.concatenate([surface.vertex for surface in surfaces])
    low, high = every.min(axis=0), every.max(axis=0)
    for surface in surfaces:
        edges, colour = outline(surface), MATERIALS.get(surface.material.name, OTHER)
        encloses = bool((np.ptp(surface.vertex, axis=0)[:2] > ENCLOSING * (high - low)[:2]).all())
        plan.add_collection(
            LineCollection(
                list(edges[..., :2]), colors="#222222" if encloses else colour, linewidths=1.0 if encloses else 0.6
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
        handles = [
            Line2D([], [], color=MATERIALS.get(name, OTHER), linewidth=4, alpha=0.6, label=name) for name in names
        ]
        plan.legend(
            handles=handles, fontsize=7, loc="upper left", bbox_to_anchor=(0, -0.12), ncols=len(names), frameon=False
        )
