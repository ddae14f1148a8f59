"""Make the tables of docs/development/speed.md and docs/large-data.md."""

from __future__ import annotations

import json
from typing import Any

from committed import RESULTS, load, markdown

from tasks.summarise import pareto


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
                f"{auto['seconds']:.1f} s",
                f"{auto['processor_seconds'] / _at(fixed, auto['n_primitives'])['processor_seconds']:.1f}",
            ]
        )
    columns = ["scene, split", "N, K", "PSNR [dB]", "of N = 16 ... 1024 (best)", "smallest within 0.1 dB"]
    return markdown([*columns, "parameters over its", "time", "time over that of a fit of fixed N"], rows)


def _at(fixed: list[dict[str, Any]], n: int) -> dict[str, Any]:
    return next(entry for entry in fixed if entry["n_primitives"] == n)


def speed() -> str:
    """Return every model on every scene, those on the Pareto front in bold."""
    rows = []
    for file in sorted(RESULTS.glob("speed_*.json")):
        content = json.loads(file.read_text())
        points = {p["setting"]: (p["seconds"]["median"], p["held_out"]) for p in content["models"]}
        front = pareto(points)
        for point in content["models"]:
            name = point["setting"]
            rows.append(
                [
                    f"{content['data']} {content['split']}",
                    f"**{name}**" if name in front else name,
                    f"{point['seconds']['median'] * 1e3:.2f}",
                    f"{point['psnr_db']:.2f}",
                    f"{point['fit_seconds']:.1f}" if point["fit_seconds"] else "",
                    f"{point['parameters']:,}" if "parameters" in point else "",
                ]
            )
    return markdown(["scene, split", "setting", "ms a spectrum", "held-out PSNR [dB]", "fit [s]", "parameters"], rows)


def networks() -> str:
    """Return error and seconds of every estimator on every training set, those on the Pareto front in bold."""
    rows = []
    for scene, trainings in load("networks")["scenes"].items():
        for training, entry in trainings.items():
            what = training.partition(",")[0]
            methods = entry["methods"]
            points = {
                name: (method["seconds"]["train"], method["great_circle_deg"]["median"])
                for name, method in methods.items()
            }
            front = pareto(points)
            for name, method in methods.items():
                error, change, seconds = method["great_circle_deg"], method["change"], method["seconds"]
                rows.append(
                    [
                        f"{scene}, {what}, {entry['n_train']} spectra",
                        f"**{name}**" if name in front else name,
                        f"{error['median']:.2f} [{error['low']:.2f}, {error['high']:.2f}]",
                        f"{change['change']:+.0%} [{change['low']:+.0%}, {change['high']:+.0%}]",
                        f"{seconds['train']:.1f}",
                        f"{seconds['estimate'] * 1e3:.1f}",
                    ]
                )
    columns = ["scene, training set", "estimator", "held-out error [deg]", "against kernel_regression", "train [s]"]
    return markdown([*columns, "ms a spectrum"], rows)


def drawing() -> str:
    """Return every rendering of the default model of each scene, those on the Pareto front in bold."""
    rows = []
    for file in sorted(RESULTS.glob("speed_*.json")):
        content = json.loads(file.read_text())
        own = [p for p in content["drawing"] if p["own_grid"]]
        front = pareto({p["setting"]: (p["seconds"]["median"], p["numerical"]) for p in own})
        for p in own:
            name = f"**{p['setting']}**" if p["setting"] in front else p["setting"]
            cells = [f"{p['seconds']['median'] * 1e3:.2f}", f"{p['numerical']:.0e}", f"{p['held_out']:.4f}"]
            rows.append([f"{content['data']} {content['split']}", name, *cells])
    return markdown(["scene, split", "setting", "ms a spectrum", "RMS numerical", "RMS held-out"], rows)


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
        values = [target[key] for key in ("least", "goal", "measured")]
        cells = [f"{value:.0%}" if target["least"] < 1 else f"{value:,.0f}" for value in values]
        rows.append([target["what"], *cells, "met" if target["met"] else "missed"])
    return markdown(["spectra per second, 90 x 360", "at least", "goal", "measured", "state"], rows)


def gpu_seconds() -> str:
    """Return seconds of the fits on a GPU."""
    return markdown(["fit", "seconds"], [[name, f"{s:.1f}"] for name, s in load("gpu_training")["seconds"].items()])


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


def busy() -> str:
    """Return the seconds of a training step, idle and beside other work, by the busy-waiting time of threads."""
    steps = {(row["spins"], row["neighbour"]): row["step_s"] for row in load("busy")["rows"]}
    rows = [
        [f"{spins:,}", f"{steps[spins, False]:.2f} s", f"{steps[spins, True]:.2f} s"]
        for spins in dict.fromkeys(spins for spins, _ in steps)
    ]
    return markdown(["GOMP_SPINCOUNT", "idle", "beside a loop on one core"], rows)
