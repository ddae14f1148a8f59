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


# mean 3D error [m] and right floors of published methods on the same rows, best first: 1-NN of the comparisons by
# J. Torres-Sospedra et al., CNN-ELM (D. Quezada-Gaibor et al.), CNNLoc (X. Song et al.)
PUBLISHED: dict[str, tuple[dict[str, float], dict[str, float]]] = {
    "ts-dsi1": ({"1-NN": 4.95}, {}),
    "ts-lib1": ({"1-NN": 3.04}, {"CNN-ELM": 0.999, "1-NN": 0.992}),
    "ts-lib2": ({"1-NN": 4.20}, {"1-NN": 0.998, "CNN-ELM": 0.991}),
    "ts-tut2": ({"1-NN": 12.89}, {"1-NN": 0.943, "CNN-ELM": 0.921}),
    "ts-tut5": ({"1-NN": 6.92}, {"CNN-ELM": 0.983, "CNNLoc": 0.981}),
    "ts-uji1": ({"CNNLoc": 8.46, "1-NN": 10.81}, {}),
    "ts-ujib1": ({"1-NN": 3.08}, {}),
}


def locating_benchmark() -> str:
    """Return mean 3D errors [m] and right floors on public splits beside published ones."""
    rows = []
    for name, measured in load("locating_rssi")["sets"].items():
        if (known := PUBLISHED.get(name.split()[0])) is None:
            continue
        found = [measured["localizers"].get(n) for n in ("nearest", "knn", "posterior")]
        errors = [f"{one['position_error_m']['mean']:.2f}" if one else "" for one in found]
        floors = [f"{one['floor_hit_rate']:.1%}" if one and "floor_hit_rate" in one else "" for one in found[1:]]
        published = (", ".join(f"{method} {value:.2f}" for method, value in known[0].items()),)
        published += (", ".join(f"{method} {value:.1%}" for method, value in known[1].items()),)
        n_test, seconds = measured["n_test"], measured["localizers"]["posterior"]["seconds"]
        regions = [f"{measured['coverage']['0.8']:.0%}", f"{seconds['fit'] + seconds['predict']:.0f} s"]
        rows.append([name, str(n_test), published[0], *errors, published[1], *floors, *regions])
    columns = ["data, split", "test rows", "published [m]", "nearest [m]", "knn [m]", "posterior [m]"]
    floors = ["published floors", "knn floors", "posterior floors"]
    return markdown([*columns, *floors, "80 % regions hold", "fit and locate"], rows)


def locating_rssi() -> str:
    """Return position errors of each localizer, median and 90 % [m]."""
    rows, names = [], list(dict.fromkeys(n for s in load("locating_rssi")["sets"].values() for n in s["localizers"]))
    for name, measured in load("locating_rssi")["sets"].items():
        errors = {n: entry["position_error_m"] for n, entry in measured["localizers"].items()}
        cells = [f"{errors[n]['median']:.2f} / {errors[n]['p90']:.2f}" if n in errors else "" for n in names]
        coverage = measured["coverage"]["0.8"]
        rows.append([name, str(next(iter(errors.values()))["n"]), *cells, f"{coverage:.0%}"])
    return markdown(["data, split", "test rows", *names, "80 % regions hold"], rows)
