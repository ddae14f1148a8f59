"""Tables of methods against scenes and measured fractions, for the pages that compare field models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from committed import markdown

Rows = dict[str, dict[str, Any]]  # by method
Published = dict[str, dict[str, tuple[float, float, float]]]  # PSNR, SSIM and L1 by scene and method, on other spectra

# median elevation and azimuth errors [deg] of the paper's table at each measured fraction, on its own spectra
PAPER_TURBO = {
    "0.1": {"swiftwrf": (0.592, 1.769), "nerf2": (0.957, 2.548), "wrfgs": (1.056, 4.506)},
    "0.3": {"swiftwrf": (0.553, 1.737), "nerf2": (0.850, 1.903), "wrfgs": (0.948, 2.364)},
    "0.5": {"swiftwrf": (0.410, 1.498), "nerf2": (0.704, 1.663), "wrfgs": (0.878, 1.854)},
    "0.7": {"swiftwrf": (0.370, 1.173), "nerf2": (0.674, 1.478), "wrfgs": (0.727, 1.629)},
}


def scores(scenes: dict[str, Rows], paper: Published) -> str:
    """Return a row for each method and a column for each scene, the best PSNR of a scene in bold, and rows of the paper."""
    best = {name: max(row["psnr_db"]["median"] for row in rows.values()) for name, rows in scenes.items()}
    table = []
    for method in dict.fromkeys(method for rows in scenes.values() for method in rows):
        own = {name: rows.get(method) for name, rows in scenes.items()}
        table.append(
            [f"`{method}`", *(_score(r, bool(r) and r["psnr_db"]["median"] == best[n]) for n, r in own.items())]
        )
        published = [paper.get(name, {}).get(method) for name in scenes]
        if any(published):
            cells = (f"{x[0]:.2f} / {x[1]:.3f} / {x[2]:.4f}" if x else "" for x in published)
            table.append([f"paper: {method.removesuffix('_paper')}", *cells])
    return markdown(["method", *scenes], table)


def _score(row: dict[str, Any] | None, best: bool) -> str:
    if row is None:
        return ""
    psnr = f"{row['psnr_db']['median']:.2f}"
    return f"{f'**{psnr}**' if best else psnr} / {row['ssim']['median']:.3f} / {row['l1']['mean']:.4f}"


def costs(scenes: dict[str, Rows]) -> str:
    """Return seconds and size of every method, from the least to the greatest scene."""
    by_method: dict[str, list[dict[str, Any]]] = {}
    for rows in scenes.values():
        for method, row in rows.items():
            by_method.setdefault(method, []).append(row)

    def of(values: list[float], digits: int = 0) -> str:
        low, high = (f"{value:,.{digits}f}" for value in (min(values), max(values)))
        return low if low == high else f"{low} to {high}"

    steps = any("steps" in row for rows in by_method.values() for row in rows)
    table = [
        [
            f"`{method}`",
            *([f"{rows[0]['steps']:,}" if rows[0].get("steps") else ""] if steps else []),
            of([row["fit_seconds"] for row in rows]),
            of([row["ms"]["median"] for row in rows], 1),
            of([row["megabytes"] for row in rows], 2),
        ]
        for method, rows in by_method.items()
    ]
    return markdown(["method", *(["steps"] if steps else []), "fit [s]", "ms a spectrum", "MB"], table)


def angles(fractions: dict[str, Rows]) -> str:
    """Return elevation and azimuth errors of the network with each synthesizer, and those of the paper."""

    def cell(errors: dict[str, Any]) -> str:
        return f"{errors['elevation_deg']['median']:.2f} / {errors['azimuth_deg']['median']:.2f}"

    def is_shown(method: str) -> bool:
        return method.startswith(("measured_", "turbo_"))

    paper = []
    for name in PAPER_TURBO["0.1"]:
        pairs = [PAPER_TURBO[fraction][name] for fraction in fractions]
        paper.append([f"paper: turbo_{name}", *(f"{elevation:.2f} / {azimuth:.2f}" for elevation, azimuth in pairs)])
    return by_fraction(fractions, "azimuth_deg", cell, is_shown, paper)


def by_fraction(
    fractions: dict[str, Rows],
    angle: str,
    cell: Callable[[dict[str, Any]], str],
    is_shown: Callable[[str], bool],
    further: Sequence[list[str]] = (),
) -> str:
    """Return the table of some methods at each measured fraction, the best at the first fraction first.

    Args:
        fractions: Errors of each method at each measured fraction.
        angle: Name of the error that sorts the methods.
        cell: Text of the errors of a method.
        is_shown: Whether the table has a method.
        further: Last rows.
    """
    first = next(iter(fractions.values()))
    names = sorted(filter(is_shown, first), key=lambda name: float(first[name][angle]["median"]))
    rows = [[f"`{name}`", *(cell(methods[name]) for methods in fractions.values())] for name in names]
    return markdown(["method", *(f"{float(key):.0%} measured" for key in fractions)], [*rows, *further])
