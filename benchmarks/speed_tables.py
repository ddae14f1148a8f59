"""Make the tables of docs/development/speed.md and docs/large-data.md."""

from __future__ import annotations

import json
from typing import Any

from committed import RESULTS, load, markdown

from tasks.summarise import pareto

DEVICES = {"cpu": "CPU", "cuda": "GPU"}


def size() -> str:
    """Return the size that the fit chose beside the best of all sizes."""
    rows = []
    for scene, result in load("model_size")["scenes"].items():
        auto, fixed = result["auto"], result["fixed"]
        quality = {entry["n_primitives"]: entry["psnr_db"]["median"] for entry in fixed}
        best = max(quality, key=lambda n: quality[n])
        enough = next(entry for entry in fixed if entry["psnr_db"]["median"] >= quality[best] - 0.1)
        rows.append(
            [
                scene,
                f"{auto['n_primitives']}, {auto['rank']}",
                f"{auto['psnr_db']['median']:.2f}",
                f"{min(quality.values()):.2f} to {quality[best]:.2f} ({best})",
                str(enough["n_primitives"]),
                f"{auto['parameters'] / enough['parameters']:.1f}",
                f"{auto['processor_seconds'] / _at(fixed, auto['n_primitives'])['processor_seconds']:.1f}",
            ]
        )
    columns = ["scene, split", "N, K", "PSNR [dB]", "of N = 16 ... 1024 (best)", "smallest within 0.1 dB"]
    return markdown([*columns, "parameters over its", "time over that of a fit of fixed N"], rows)


def _at(fixed: list[dict[str, Any]], n: int) -> dict[str, Any]:
    return next(entry for entry in fixed if entry["n_primitives"] == n)


def speed() -> str:
    """Return milliseconds a spectrum, held-out PSNR and seconds of the fit of every model on every scene."""
    cells: Cells = {}
    for file in sorted(RESULTS.glob("speed_*.json")):
        content = json.loads(file.read_text())
        front = pareto({p["setting"]: (p["seconds"]["median"], p["held_out"]) for p in content["models"]})
        for point in content["models"]:
            text = f"{point['seconds']['median'] * 1e3:.2f} / {point['psnr_db']:.2f}"
            text += f" / {point['fit_seconds']:.1f}" if point["fit_seconds"] else ""
            _put(cells, point["setting"].partition(" (")[0], _scene(content), text, point["setting"] in front)
    return _crossed("setting", cells)


def networks() -> str:
    """Return the median error and the training time of every estimator on the training sets that are partly measured."""
    cells: Cells = {}
    for scene, trainings in load("networks")["scenes"].items():
        for training, entry in trainings.items():
            if training.startswith("all"):
                continue
            methods = entry["methods"]
            points = {name: (m["seconds"]["train"], m["great_circle_deg"]["median"]) for name, m in methods.items()}
            front = pareto(points)
            column = f"{scene}, {training.partition(',')[0]}, {entry['n_train']}"
            for name, (seconds, error) in points.items():
                _put(cells, name, column, f"{error:.2f} / {seconds:.0f}", name in front)
    return _crossed("estimator", cells)


def drawing() -> str:
    """Return milliseconds a spectrum and numerical error of the default model of each scene, in single precision."""
    cells: Cells = {}
    for file in sorted(RESULTS.glob("speed_*.json")):
        content = json.loads(file.read_text())
        own = [p for p in content["drawing"] if p["own_grid"] and "weights" not in p["setting"]]
        for p in own:
            text = f"{p['seconds']['median'] * 1e3:.2f} / {p['numerical']:.0e}"
            _put(cells, p["setting"].rpartition(", ")[0], _scene(content), text, False)
    return _crossed("setting", cells)


Cells = dict[str, dict[str, str]]  # text by row and column


def _scene(content: dict[str, Any]) -> str:
    return f"{content['data']} {content['split']}"


def _put(cells: Cells, row: str, column: str, text: str, bold: bool) -> None:
    cells.setdefault(row, {})[column] = f"**{text}**" if bold else text


def _crossed(what: str, cells: Cells) -> str:
    """Return a table of rows and columns."""
    columns = list(dict.fromkeys(column for row in cells.values() for column in row))
    rows = [[name, *(row.get(column, "") for column in columns)] for name, row in cells.items()]
    return markdown([what, *columns], rows)


def gpu_rates() -> str:
    """Return spectra per second on a GPU by number of primitives and batch size."""
    rates = ("forward", "forward_backward", "model", "synthesize")
    rows = [
        [f"{row['n']:,}", f"{row['batch']:,}", *(f"{row[f'{name}_per_s']['median']:,.0f}" for name in rates)]
        for row in load("gpu_rates")["rows"]
    ]
    columns = ["primitives", "batch", "forward", "forward and backward", "model", "synthesize"]
    return markdown(columns, rows)


def gpu_targets() -> str:
    """Return the rates of the GPU beside their targets."""
    rows = []
    for target in load("gpu_rates")["targets"]:
        values = [target[key] for key in ("least", "measured")]
        cells = [f"{value:.0%}" if target["least"] < 1 else f"{value:,.0f}" for value in values]
        rows.append([target["what"], *cells, "met" if target["met"] else "missed"])
    return markdown(["spectra per second, 90 x 360", "at least", "measured", ""], rows)


def gpu_seconds() -> str:
    """Return seconds of the fits on a GPU."""
    return markdown(["fit", "seconds"], [[name, f"{s:.1f}"] for name, s in load("gpu_training")["seconds"].items()])


def gpu_single() -> str:
    """Return milliseconds for one spectrum on a machine with a GPU."""
    learning, locating = load("gpu_update"), load("gpu_locating")
    rows = [
        [f"score and learn, `{row['model']}` of {row['n']:,}", DEVICES[row["device"]], f"{row['ms_per_spectrum']:.1f}"]
        for row in learning["rows"]
    ]
    rows.append(["locate, `matched_field`", DEVICES["cpu"], f"{1e3 * locating['seconds']['spectrum']:.1f}"])
    return markdown(["one spectrum", "device", "milliseconds"], rows)


def scaling() -> str:
    """Return processor seconds and peak memory of each stage at each size, and the growth to the largest size."""
    content = load("scaling")
    sizes = [row["n"] for row in content["rows"]]
    rows = []
    for label, growth in content["slopes"].items():
        stage, part = label.split(", ")
        cells = [f"{row['stages'][stage][part]:.1f} s" for row in content["rows"]]
        peaks = [f"{row['stages'][stage]['rss_gib']:.1f}" for row in content["rows"]]
        anonymous = content["rows"][-1]["stages"][stage]["anonymous_gib"]
        name = f"{stage}, {part.removesuffix(' seconds')}" if " " in part else stage
        rows.append([name, *cells, f"{list(growth.values())[-1]:.2f}", " / ".join(peaks), f"{anonymous:.1f}"])
    columns = ["stage", *(f"{n:,}" for n in sizes), f"exponent to {sizes[-1]:,}", "peak of each size [GiB]"]
    return markdown([*columns, "not from files [GiB]"], rows)


def scaling_rssi() -> str:
    """Return processor seconds and peak memory of the RSSI model."""
    content = load("scaling_rssi")
    rows = [
        [
            f"{row['rows']:,.0f}",
            f"{row['receivers']:.0f}",
            f"{row['fit seconds']:.1f} s",
            f"{row['predict seconds']:.2f} s",
            f"{row['rss_gib']:.1f}",
        ]
        for row in content["rows"]
    ]
    return markdown(["rows", "receivers", "fit", f"{content['predicted']:,} positions", "peak [GiB]"], rows)


def scaling_quality() -> str:
    """Return the median PSNR between the positions of the walk."""
    content = load("scaling")
    names = [stage for stage, values in content["rows"][0]["stages"].items() if "psnr_db" in values]
    rows = [[f"{row['n']:,}", *(f"{row['stages'][name]['psnr_db']:.1f}" for name in names)] for row in content["rows"]]
    return markdown(["spectra", *names], rows)
