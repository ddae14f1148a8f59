"""Rewrite the tables of README and docs from the committed results: python benchmarks/tables.py."""

from __future__ import annotations

import re
import statistics
from typing import Any

import aoa_tables
import field_tables
import rssi_tables
import speed_tables
import targets
from geometry import SIDES
from record import ROOT, load, markdown


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


def _millimetres(plane: dict[str, Any] | None) -> str:
    return "not found" if plane is None else f"{plane['error_mm']:.1f}"


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


MODULES = (aoa_tables, field_tables, rssi_tables, speed_tables, targets)
FILES = ("README.md", *sorted(file.relative_to(ROOT).as_posix() for file in (ROOT / "docs").rglob("*.md")))


def table(name: str) -> str:
    """Return a table by the name of its function, here or in one of the modules."""
    functions = [getattr(module, name) for module in MODULES if hasattr(module, name)]
    text: str = (functions[0] if functions else globals()[name])()
    return text


def rewrite(text: str) -> str:
    """Return the text with each block between `<!-- NAME -->` and `<!-- /NAME -->` replaced by its table."""
    for name in re.findall(r"<!-- (\w+) -->", text):
        block = f"<!-- {name} -->\n{table(name)}\n<!-- /{name} -->"
        text = re.sub(rf"<!-- {name} -->.*?<!-- /{name} -->", lambda _, block=block: block, text, flags=re.DOTALL)
    return text


if __name__ == "__main__":
    for name in FILES:
        (ROOT / name).write_text(rewrite((ROOT / name).read_text()))
