"""Tables of methods against scenes, for the pages that compare field models."""

from __future__ import annotations

from typing import Any

from committed import markdown

Rows = dict[str, dict[str, Any]]  # by method
Published = dict[str, dict[str, tuple[float, float, float]]]  # PSNR, SSIM and L1 by scene and method, on other spectra


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
