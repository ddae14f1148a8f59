"""Tables of locating: matched fields on spectra, localizers on RSSI."""

from __future__ import annotations

from typing import Any

from committed import RESULTS, load, markdown

SPECTRA = ("locating_rooms", "locating_newrf")


def locating_spectra() -> str:
    """Return errors of directions and positions by matched-field processing, medians over the draws."""
    rows = []
    for name in SPECTRA:
        if not (RESULTS / f"{name}.json").is_file():
            continue
        for scene, fractions in load(name)["scenes"].items():
            for fraction, entry in fractions.items():
                rows.append([scene, f"{float(fraction):.0%}", str(len(entry["draws"])), *_cells(entry["median"])])
    columns = [
        "scene",
        "measured",
        "random choices",
        "kernel regression [deg]",
        "matched field [deg]",
        "position [m]",
        "80 % regions hold",
        "fit",
        "200 spectra",
    ]
    return markdown(columns, rows)


def _cells(median: dict[str, Any]) -> list[str]:
    def both(name: str, digits: int) -> str:
        value = median.get(name)
        return f"{value['median']:.{digits}f} / {value['p90']:.{digits}f}" if value else ""

    seconds = median.get("seconds")
    return [
        both("kernel_regression_angle_deg", 2),
        both("angle_deg", 2),
        both("position_m", 3),
        f"{median['coverage_80']:.0%}" if "coverage_80" in median else "",
        f"{seconds['fit']:.0f} s" if seconds else "",
        f"{seconds['locate']:.0f} s" if seconds else "",
    ]


def locating_rssi() -> str:
    """Return position errors of each localizer, median and 90 % [m]."""
    rows, names = [], list(dict.fromkeys(n for s in load("locating_rssi")["sets"].values() for n in s["localizers"]))
    for name, measured in load("locating_rssi")["sets"].items():
        errors = {n: entry["position_error_m"] for n, entry in measured["localizers"].items()}
        cells = [f"{errors[n]['median']:.2f} / {errors[n]['p90']:.2f}" if n in errors else "" for n in names]
        coverage = measured["coverage"]["0.8"]
        rows.append([name, str(next(iter(errors.values()))["n"]), *cells, f"{coverage:.0%}"])
    return markdown(["data, split", "test rows", *names, "80 % regions hold"], rows)
