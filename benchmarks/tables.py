"""Rewrite the tables of README and docs from the committed results: python benchmarks/tables.py."""

from __future__ import annotations

import re
import statistics
from typing import Any

from committed import (
    ROOT,
    aoa_shares,
    change_text,
    interval,
    load,
    markdown,
    turbo_condition,
)
from comparison_tables import comparison, comparison_cost, comparison_counts, comparison_turbo
from geometry import SIDES, WALLS, nearest
from locating_tables import locating_benchmark, locating_rssi, locating_spectra
from measured_tables import measured_spectra
from paper_scale_tables import (
    paper_scale,
    paper_scale_angles,
    paper_scale_aoa,
    paper_scale_block,
    paper_scale_cost,
    paper_scale_counts,
    paper_scale_density,
    paper_scale_gpu,
    paper_scale_gpu_cost,
)
from rssi_tables import rssi_glance, rssi_heads, rssi_methods
from speed_tables import (
    drawing,
    gpu_rates,
    gpu_seconds,
    gpu_single,
    gpu_targets,
    networks,
    scaling,
    scaling_quality,
    scaling_rssi,
    size,
    speed,
)
from targets import aoa_targets, rssi_targets, synthesis_targets

from augment.cross_validation import LOCATOR


def synthesis() -> str:
    """Return median SSIM and PSNR of each field model on each scene."""
    rows = []
    for scene, result in load("synthesis")["scenes"].items():
        scores = result["synthesizers"]
        cells = [f"{s['ssim']['median']:.3f} / {s['psnr_db']['median']:.1f}" for s in scores.values()]
        own = scores["swiftwrf"]
        rows.append([scene, *cells, f"{own['seconds']['fit']:.0f} s", f"{own['covered_by_80']:.0%}"])
    return markdown(["scene, split", *scores, "fit of swiftwrf", "its 80 % interval covers"], rows)


def aoa() -> str:
    """Return median angular errors of each run, and what synthetic spectra change, with paired intervals."""
    rows = []
    for share, mix, result in aoa_shares():
        metrics, methods = result["metrics"], mix["methods"]
        turbo, best = turbo_condition(mix), mix["reference"]
        median = {name: f"{method['great_circle_deg']['median']:.2f}" for name, method in methods.items()}
        rows.append(
            [
                f"{metrics['data']}, {metrics['split']}, {metrics['moving']}",
                f"{float(share):.0%}",
                median["peak"],
                median["constant"],
                f"{median[best]} `{best}`",
                median["measured_only"],
                median[turbo.method],
                *(change_text(methods[turbo.method]["changes"][other]) for other in ("measured_only", best)),
                median.get(LOCATOR, ""),
                median["measured_all"],
            ]
        )
    columns = ["scene, split, moving end", "measured", "peak", "constant", "best", "measured only", "turbo"]
    columns += ["against measured only", "against the best", "matched field", "all measured"]
    return markdown(columns, rows)


def reliability() -> str:
    """Return how each kind of attack ended."""
    done = load("reliability")
    ends = done["mutations"].values()
    read, refused, wrong = (sum(end.get(key, 0) for end in ends) for key in ("read", "refused", "wrong"))
    lines, right, kills, disks, races = (done[part] for part in ("commands", "right", "kills", "disks", "races"))
    rows = [
        [f"{read + refused:,} mutations of {len(ends)} kinds of files", f"{read} read, {refused:,} refused", wrong],
        [
            f"{sum(lines.values()) - lines['wrong']} mistyped command lines",
            f"{lines['exit 2']} refused",
            lines["wrong"],
        ],
        [f"{sum(right.values()) - right['wrong']} right command lines", f"{right['exit 0']} done", right["wrong"]],
        [f"{kills['kills']} kills", f"{kills['runs']} runs resumed to the same tables", kills["wrong"]],
        [f"{disks['full disks']} full disks", "each a sentence, nothing half-written", disks["wrong"]],
        [f"{races['races']} races for one directory", "one run each", races["wrong"]],
    ]
    for kind, end in done.get("attempts", {}).items():
        read, refused = (end.get(key, 0) for key in ("read", "refused"))
        rows.append([f"{read + refused:,} times: {kind}", f"{read} plausible, {refused:,} refused", end["wrong"]])
    return markdown(["attack", "end", "wrong"], [[str(cell) for cell in row] for row in rows])


def headline() -> str:
    """Return the errors in each scene with 30 % of the positions measured."""
    rows = []
    for share, mix, result in aoa_shares():
        if share != "0.3":
            continue
        metrics, methods = result["metrics"], mix["methods"]
        shown = ("peak", "constant", "measured_only", turbo_condition(mix).method, LOCATOR, "measured_all")
        cells = [interval(methods[name]["great_circle_deg"]) if name in methods else "" for name in shown]
        rows.append([f"{metrics['data']}, {metrics['split']}, {metrics['moving']} moves", *cells])
    columns = [
        "strongest peak",
        "mean direction",
        "measured spectra only",
        "with synthetic spectra",
        "matched field",
        "all spectra measured",
    ]
    return markdown(["scene, split", *columns], rows)


def headline_rssi() -> str:
    """Return errors of RSSI and of positions on the measured sets of which both are known."""
    located, rows = load("locating_rssi")["sets"], []
    for name, found in load("rssi")["sets"].items():
        if name not in located:
            continue
        methods, best = found["methods"], found["best_baseline"]
        own = methods["swiftwrf"]
        errors = (methods["mri_receiver"], methods[best], own)
        cells = [f"{entry['abs_error_db']['median']:.2f} / {entry['abs_error_db']['p90']:.1f}" for entry in errors]
        cells[1] += f" (`{best}`)"
        position = {method: entry["position_error_m"] for method, entry in located[name]["localizers"].items()}
        cells.append(f"{own['coverage']:.0%}")
        cells += [
            f"{position[method]['median']:.2f} / {position[method]['p90']:.2f}" for method in ("knn", "posterior")
        ]
        rows.append([name, *cells, f"{located[name]['coverage']['0.8']:.0%}"])
    columns = ["RSSI [dB]: path-loss model", "best baseline", "SwiftWRF", "80 % intervals cover"]
    columns += ["position [m]: nearest fingerprints", "posterior", "80 % regions cover"]
    return markdown(["data, split", *columns], rows)


def room() -> str:
    """Return the largest error of the planes that each run found, where the true ones are known."""
    methods, rows = ("geometry", "hybrid", "coarray"), []
    for share, mix, result in aoa_shares():
        found, walls = result.get("geometry", {}).get(share), WALLS.get(result["metrics"]["data"])
        if found is None or walls is None:
            continue
        near = [nearest(found["planes"], *wall) for wall in zip(SIDES, walls, strict=True)]
        errors = [plane["error_mm"] for plane in near if plane]
        n = len(found["planes"])
        certain = sum(plane["certain"] for plane in found["planes"])
        scene = f"{result['metrics']['data']}, {result['metrics']['moving']}"
        quality = [f"{mix['synthesis'][s]['psnr_db']['median']:.1f}" for s in methods]
        cells = [f"{len(errors)} of {len(walls)}", f"{max(errors):.1f}", f"{certain} of {n}"]
        rows.append([scene, str(mix["n_measured"]), *cells, *quality])
    columns = ["scene, moving end", "spectra", "walls found", "largest error [mm]", "identifiable", *methods]
    return markdown(columns, rows)


def walls() -> str:
    """Return the errors of the planes that geometry found in several draws of the measured fraction."""
    rows = []
    for case, found in load("geometry")["cases"].items():
        scene, moving, _, draw = case.split(", ")
        planes = [plane for plane in found["walls"].values() if plane]
        cells = [_millimetres(plane) for plane in found["walls"].values()]
        covered = sum(plane["error_mm"] <= 3 * plane["std_mm"] for plane in planes if plane["certain"])
        certain = f"{covered} of {sum(plane['certain'] for plane in planes)}"
        quality = [f"{found['psnr_db'][name]['median']:.1f}" for name in ("geometry", "hybrid")]
        what = f"{scene}, {moving.removeprefix('moving ')}, {draw}"
        rows.append([what, str(found["positions"]), *cells, certain, *quality, f"{found['cpu_seconds']:.0f} s"])
    columns = [
        "scene, moving end",
        "spectra",
        *(f"{side} [mm]" for side in SIDES),
        "identifiable ones within 3 deviations",
    ]
    return markdown([*columns, "geometry", "hybrid", "processor time"], rows)


def random_rooms() -> str:
    """Return how many of the random rooms are found, and how many planes are called certain."""
    rows = []
    for case, rooms in load("random_rooms")["rooms"].items():
        kind, noise = case.split(", ")
        found, near = sum(room["near"] == 6 for room in rooms), sum(room["near"] for room in rooms)
        certain, wrong = (sum(room[key] for room in rooms) for key in ("certain", "certain_and_wrong"))
        seconds = statistics.mean(room["cpu_seconds"] for room in rooms)
        cells = [
            f"{found} of {len(rooms)}",
            f"{near} of {6 * len(rooms)}",
            str(certain),
            str(wrong),
            f"{seconds:.0f} s",
        ]
        rows.append([kind, noise, *cells])
    return markdown(
        ["gains", "phase noise", "rooms", "planes", "identifiable", "of them wrong", "processor time"], rows
    )


def _millimetres(plane: dict[str, Any] | None) -> str:
    return "not found" if plane is None else f"{plane['error_mm']:.1f}"


def hard_cases() -> str:
    """Return the largest errors over cutoffs of each backend in each case."""
    found: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for row in load("stability_cpu")["backends"]:
        found.setdefault(row["case"], {}).setdefault(row["backend"], []).append(row)
    rows = []
    for case, backends in found.items():
        cells = []
        for entries in backends.values():
            value = {entry["cutoff"]: entry["value"] for entry in entries}
            gradient = max(max(entry["gradient"], entry["magnitude_gradient"]) for entry in entries)
            cells.append(f"{value[None]:.0e}, {value[1e-4]:.0e}; {gradient:.0e}")
        rows.append([case, next(iter(backends.values()))[0]["rule"].replace("|", "\\|"), *cells])
    return markdown(["case", "rule", *(f"`{backend}` (float32)" for backend in found[rows[0][0]])], rows)


def precision() -> str:
    """Return the errors of rounded numbers."""
    rows = [[row["what"], f"{row['error']:.0e}", f"{row['psnr_db']:.0f}"] for row in load("stability_cpu")["precision"]]
    return markdown(["what is rounded", "largest error of \\|A\\| over the largest", "PSNR [dB]"], rows)


def hard_fits() -> str:
    """Return how each hard fit ended."""
    rows = []
    for row in load("stability_cpu")["fits"]:
        if row["refusal"]:
            ended = f"refused: {row['refusal']}"
        else:
            ended = f"{row['psnr_db']:.1f} dB on its own spectra (their mean: {row['mean_psnr_db']:.1f})"
        rows.append([row["case"], str(row["n"]), ended, f"{row['seconds']:.0f} s"])
    return markdown(["case", "spectra", "how the fit ended", "time"], rows)


# SSIM and mean L1 of the paper's tables, on its own data
PAPER = {"seen at 0.5 degrees": "0.898 / 0.039"}


def ablation() -> str:
    """Return median SSIM / mean L1 / median PSNR of every variant of the ablation on every scene."""
    scenes = load("ablation")["scenes"] | load("ablation_large")["scenes"]
    names = list(dict.fromkeys(name for scene in scenes.values() for name in scene["variants"]))
    rows = []
    for name in names:
        cells = []
        for scene in scenes.values():
            scores = scene["variants"].get(name, {})
            if "ssim" in scores:
                ssim, psnr = (scores[key]["median"] for key in ("ssim", "psnr_db"))
                cells.append(f"{ssim:.3f} / {scores['l1']['mean']:.4f} / {psnr:.1f}")
            else:
                cells.append(scores.get("refusal", ""))
        rows.append([name, *cells, PAPER.get(name, "")])
    return markdown(["variant", *scenes, "paper: SSIM / L1"], rows)


def raytracing() -> str:
    """Return the median PSNR of every method in the furnished rooms, and the number of planes."""
    rows = []
    for scene, result in load("raytracing")["scenes"].items():
        scores = result["methods"]
        cells = [f"{s['psnr_db']['median']:.1f}" for s in scores.values()]
        certain = sum(plane["certain"] for plane in result["planes"])
        traced = result["traced"]
        rows.append([scene, f"{traced['paths_per_position']:.0f}", *cells, f"{certain} of {len(result['planes'])}"])
    return markdown(["scene, moving end", "paths a position", *scores, "identifiable planes"], rows)


TABLES = {
    "scaling": scaling,
    "scaling_quality": scaling_quality,
    "scaling_rssi": scaling_rssi,
    "gpu_rates": gpu_rates,
    "gpu_seconds": gpu_seconds,
    "gpu_single": gpu_single,
    "gpu_targets": gpu_targets,
    "headline": headline,
    "headline_rssi": headline_rssi,
    "locating_spectra": locating_spectra,
    "locating_rssi": locating_rssi,
    "locating_benchmark": locating_benchmark,
    "reliability": reliability,
    "synthesis": synthesis,
    "measured_spectra": measured_spectra,
    "aoa": aoa,
    "room": room,
    "walls": walls,
    "random_rooms": random_rooms,
    "size": size,
    "hard_cases": hard_cases,
    "precision": precision,
    "hard_fits": hard_fits,
    "speed": speed,
    "drawing": drawing,
    "networks": networks,
    "ablation": ablation,
    "comparison": comparison,
    "comparison_cost": comparison_cost,
    "raytracing": raytracing,
    "comparison_counts": comparison_counts,
    "comparison_turbo": comparison_turbo,
    "paper_scale": paper_scale,
    "paper_scale_angles": paper_scale_angles,
    "paper_scale_aoa": paper_scale_aoa,
    "paper_scale_block": paper_scale_block,
    "paper_scale_cost": paper_scale_cost,
    "paper_scale_counts": paper_scale_counts,
    "paper_scale_density": paper_scale_density,
    "paper_scale_gpu": paper_scale_gpu,
    "paper_scale_gpu_cost": paper_scale_gpu_cost,
    "synthesis_targets": synthesis_targets,
    "aoa_targets": aoa_targets,
    "rssi_targets": rssi_targets,
    "rssi_glance": rssi_glance,
    "rssi_heads": rssi_heads,
    "rssi_methods": rssi_methods,
}
DOCS = sorted(file.relative_to(ROOT).as_posix() for file in (ROOT / "docs").rglob("*.md"))
FILES = ("README.md", *DOCS)


def rewrite(text: str) -> str:
    """Return the text with each block between `<!-- NAME -->` and `<!-- /NAME -->` replaced by its table."""
    for name in re.findall(r"<!-- (\w+) -->", text):
        block = f"<!-- {name} -->\n{TABLES[name]()}\n<!-- /{name} -->"
        text = re.sub(rf"<!-- {name} -->.*?<!-- /{name} -->", lambda _, block=block: block, text, flags=re.DOTALL)
    return text


if __name__ == "__main__":
    for name in FILES:
        (ROOT / name).write_text(rewrite((ROOT / name).read_text()))
