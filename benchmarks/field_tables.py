"""Tables of the studies of field models, with the paper's numbers beside the measured ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from pandas import DataFrame
from record import interval, load, markdown

from augment.turbo.condition import LOCATED, NETWORK

Row = dict[str, Any]
Scores = dict[str, tuple[float, float]]  # median PSNR [dB] and median SSIM by method, on other spectra
PAPER_S23: Scores = {
    "vae": (18.62, 0.7133),
    "dcgan": (18.81, 0.7189),
    "nerf2": (21.76, 0.7732),
    "wrfgs": (20.72, 0.7588),
    "swiftwrf": (24.75, 0.8714),
}
PAPER_ROOMS: dict[str, Scores] = {  # of rooms of these names
    "conference-transmitter": {
        "vae": (21.54, 0.7095),
        "dcgan": (22.41, 0.7290),
        "nerf2": (26.12, 0.8122),
        "wrfgs": (25.53, 0.7888),
        "swiftwrf_paper": (30.75, 0.9039),
    },
    "conference-receiver": {
        "vae": (23.93, 0.7664),
        "dcgan": (21.26, 0.7164),
        "nerf2": (28.21, 0.8528),
        "wrfgs": (26.64, 0.7916),
        "swiftwrf_paper": (30.54, 0.9137),
    },
    "office-transmitter": {
        "vae": (23.51, 0.7647),
        "dcgan": (22.55, 0.7441),
        "nerf2": (27.52, 0.8118),
        "wrfgs": (24.00, 0.7422),
        "swiftwrf_paper": (32.96, 0.9376),
    },
    "office-receiver": {
        "vae": (22.75, 0.7562),
        "dcgan": (20.95, 0.7809),
        "nerf2": (24.16, 0.7863),
        "wrfgs": (24.07, 0.7460),
        "swiftwrf_paper": (28.01, 0.8755),
    },
    "bedroom-transmitter": {
        "vae": (22.90, 0.7468),
        "dcgan": (21.66, 0.7314),
        "nerf2": (25.99, 0.8004),
        "wrfgs": (26.10, 0.7995),
        "swiftwrf_paper": (30.17, 0.9166),
    },
    "bedroom-receiver": {
        "vae": (22.57, 0.7414),
        "dcgan": (21.79, 0.7208),
        "nerf2": (25.51, 0.8057),
        "wrfgs": (25.50, 0.7901),
        "swiftwrf_paper": (28.15, 0.9023),
    },
}


def pivot(head: str, cells: Iterable[tuple[str, str, str]]) -> str:
    """Return a table of cells (row, column, text). Rows and columns are in the order in which they come first."""
    table = DataFrame(cells, columns=["row", "column", "text"])
    rows, columns = table["row"].unique(), table["column"].unique()
    table = table.pivot(index="row", columns="column", values="text").reindex(rows, columns=columns).fillna("")
    return markdown([head, *columns], [[name, *texts] for name, texts in zip(rows, table.to_numpy(), strict=True)])


def bold(text: str, is_best: bool) -> str:
    """Return the text, bold if it is the best."""
    return f"**{text}**" if is_best else text


def label(row: Row) -> str:
    """Return scene and split."""
    return f"{row['scene']} {row['split']}"


def coverage() -> str:
    """Return the fraction of test pixels inside 80 % intervals of swiftwrf, and the seconds of its fit."""
    cells = []
    for row in load("coverage")["rows"]:
        cells.append((label(row), "80 % intervals cover", f"{row['covered_by_80']:.0%}"))
        cells.append((label(row), "fit", f"{row['fit_seconds']:.0f} s"))
    return pivot("scene, split", cells)


def raytracing() -> str:
    """Return the median PSNR of every method in the furnished rooms, and the number of planes."""
    content, cells = load("raytracing"), []
    for scene, found in _by_scene(content["rows"], lambda row: str(row["scene"])).items():
        cells.append((scene, "paths a position", f"{content['described'][scene]['traced']['paths_per_position']:.0f}"))
        cells += [(scene, name, f"{row['psnr_db']['median']:.1f}") for name, row in found.items()]
        planes = found["geometry"]["planes"]
        certain = sum(plane["certain"] for plane in planes)
        cells.append((scene, "identifiable planes", f"{certain} of {len(planes)}"))
    return pivot("scene, moving end", cells)


def _by_scene(rows: Sequence[Row], name: Callable[[Row], str]) -> dict[str, dict[str, Row]]:
    """Return the rows by scene and method, of a method with several numbers of training spectra that with most."""
    found: dict[str, dict[str, Row]] = {}
    for row in rows:
        own = found.setdefault(name(row), {})
        own[row["method"]] = max(own.get(row["method"], row), row, key=lambda row: row.get("n_train", 0))
    most = {name: max(row.get("n_train", 0) for row in own.values()) for name, own in found.items()}
    return {
        name: {method: row for method, row in own.items() if row.get("n_train", 0) == most[name]}
        for name, own in found.items()
    }


def scores(scenes: dict[str, dict[str, Row]], paper: dict[str, Scores]) -> str:
    """Return a row for each method and a column for each scene, the best PSNR of a scene in bold, and rows of the paper."""
    best = {name: max(row["psnr_db"]["median"] for row in rows.values()) for name, rows in scenes.items()}
    cells = []
    for method in dict.fromkeys(method for rows in scenes.values() for method in rows):
        for name, rows in scenes.items():
            if method in rows:
                psnr, ssim = (rows[method][key]["median"] for key in ("psnr_db", "ssim"))
                cells.append((f"`{method}`", name, f"{bold(f'{psnr:.1f}', psnr == best[name])} / {ssim:.3f}"))
        published = {name: paper[name][method] for name in scenes if method in paper.get(name, {})}
        row = f"paper: {method.removesuffix('_paper')}"
        cells += [(row, name, f"{psnr:.1f} / {ssim:.3f}") for name, (psnr, ssim) in published.items()]
    return pivot("method", cells)


def comparison() -> str:
    """Return the scores of every method on every scene with all training spectra, and those of the paper."""
    paper = {name: {"psnr_db": {"median": psnr}, "ssim": {"median": ssim}} for name, (psnr, ssim) in PAPER_S23.items()}
    return scores(_by_scene(load("comparison")["rows"], label) | {"paper, other spectra of s23": paper}, {})


def with_channels() -> str:
    """Return the scores of models of paths that were fitted to spectra, and to channels."""
    return scores(_by_scene(load("with_channels")["rows"], lambda row: str(row["scene"])), {})


def _at_paper_scale(split: str) -> dict[str, dict[str, Row]]:
    rows = [row for row in load("paper_scale")["rows"] if row["split"] == split]
    return _by_scene(rows, lambda row: str(row["scene"]))


def paper_scale() -> str:
    """Return the scores of every method on the random split of every scene, and those of the paper."""
    return scores(_at_paper_scale("random"), PAPER_ROOMS)


def paper_scale_block() -> str:
    """Return the scores of every method on the block split of every scene."""
    return scores(_at_paper_scale("block"), {})


def paper_scale_cost() -> str:
    """Return seconds and size of every method on the random split, from the least to the greatest scene."""
    scenes, cells = _at_paper_scale("random"), []
    for method in dict.fromkeys(method for rows in scenes.values() for method in rows):
        rows = [own[method] for own in scenes.values() if method in own]
        cells.append((f"`{method}`", "fit [s]", _range([row["fit_seconds"] for row in rows])))
        cells.append((f"`{method}`", "ms a spectrum", _range([row["ms"]["median"] for row in rows], 1)))
        cells.append((f"`{method}`", "MB", _range([row["megabytes"] for row in rows], 2)))
    return pivot("method", cells)


def _range(values: Sequence[float], digits: int = 0) -> str:
    low, high = (f"{value:,.{digits}f}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def paper_scale_aoa() -> str:
    """Return the median angular error of each estimator and training set at each measured fraction."""
    cells = [
        (method, f"{float(fraction):.0%} measured", interval(errors["great_circle_deg"]))
        for fraction, rows in load("paper_scale")["aoa"].items()
        for method, errors in sorted(rows.items(), key=lambda row: -float(row[1]["great_circle_deg"]["median"]))
        if method in {"peak", LOCATED} or method.startswith(NETWORK)
    ]
    return pivot("estimator, training set", cells)


def updates() -> str:
    """Return when a box in the room is detected, and the PSNR of each way to learn 20 spectra after it."""
    cells = []
    for row in load("update")["change"]:
        name = f"{row['moving']} moves, box at {row['place'][0]}, {row['place'][1]} m"
        after = {model: n or "more than 72" for model, n in row["alarm_after"].items()}
        cells += [(name, f"alarm after, {model}", f"{n} spectra") for model, n in after.items()]
        kinds = {"stale": "old model", "update": "update", "adapted": "adapted", "alone": "fit to the new ones"}
        cells += [(name, f"{text} [dB]", f"{row['psnr_db_20'][kind]:.1f}") for kind, text in kinds.items()]
    for row in load("update")["unchanged"]:
        name, counts = f"{row['moving']} moves, no box", row["alarms"].items()
        cells += [(name, f"alarm after, {model}", f"{n} in {row['spectra']:,} spectra") for model, n in counts]
    return pivot("scene", cells)
