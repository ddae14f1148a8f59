"""Tables of directions and positions by spectra and channels, and the planes that runs found."""

from __future__ import annotations

from typing import Any

from record import RESULTS, load, markdown

from augment.turbo.condition import FULL_NETWORK, LOCATED, MEASURED_NETWORK, Condition, conditions_of
from augment.turbo.condition import headline as chosen
from swiftwrf.contrib.comparison.errors import ChangeMetrics

SPECTRA = ("locating_rooms", "locating_newrf")  # results of locating_aoa.py


def aoa_shares() -> list[tuple[str, dict[str, Any], dict[str, Any]]]:
    """Return key, metrics and whole result of every measured fraction of every scene, sorted by file name and fraction.

    Of several runs with the same fraction the newest one counts.
    """
    scenes: dict[tuple[str, str, str], dict[str, dict[str, Any]]] = {}
    for file in sorted(RESULTS.glob("aoa_*.json")):
        result = load(file.stem)
        metrics = result["metrics"]
        shares = scenes.setdefault((metrics["data"], metrics["split"], metrics["moving"]), {})
        for share in metrics["mixes"]:
            shares[share] = max(shares.get(share, result), result, key=lambda run: str(run["environment"]["end"]))
    return [
        (share, result["metrics"]["mixes"][share], result)
        for shares in scenes.values()
        for share, result in sorted(shares.items())
    ]


def held_out_rooms() -> str:
    """Return held-out PSNR of hybrid with a room of two searches, each without two folds, and of one, beside its test."""
    rows = []
    for row in load("held_out_rooms")["scenes"]:
        ways = [row["searched"], row["decided"]]
        psnr_db = [*(way["psnr_db"]["hybrid"] for way in ways), row["test"]["hybrid"]]
        seconds = (f"{sum(way['seconds']):.1f} s" for way in ways)
        rows.append(
            [row["scene"].partition(",")[0], str(row["n"]), *(f"{value:.2f} dB" for value in psnr_db), *seconds]
        )
    columns = ["scene", "measured", "two searches", "one search", "test positions", "processor, two", "folds of one"]
    return markdown(columns, rows)


def turbo_condition(mix: dict[str, Any]) -> Condition:
    """Return the network's condition with synthetic spectra that a user would choose."""
    return chosen(conditions_of(mix["methods"]).values())


def reference(mix: dict[str, Any]) -> str:
    """Return the estimator of smallest median error among those without synthetic spectra, in words."""
    name: str = mix["reference"]
    return name.partition(",")[0].replace("_", " ")


def change_text(found: ChangeMetrics) -> str:
    """Return a change with its interval."""
    return f"{found['change']:+.0%} [{found['low']:+.0%}, {found['high']:+.0%}]"


def aoa() -> str:
    """Return median angular errors of each run, and the change by synthetic spectra with its paired interval."""
    rows = []
    for share, mix, result in aoa_shares():
        metrics, methods = result["metrics"], mix["methods"]
        turbo, best = turbo_condition(mix).method, mix["reference"]
        median = {name: f"{method['great_circle_deg']['median']:.2f}" for name, method in methods.items()}
        cells = [
            median["peak"],
            f"{median[best]} ({reference(mix)})",
            median[MEASURED_NETWORK],
        ]
        cells += [median[turbo], change_text(methods[turbo]["changes"][MEASURED_NETWORK])]
        cells += [median.get(LOCATED, ""), median[FULL_NETWORK]]
        rows.append([f"{metrics['data']}, {metrics['split']}, {metrics['moving']}", f"{float(share):.0%}", *cells])
    columns = ["scene, split, moving end", "measured", "strongest peak", "best without synthetic", "network, measured"]
    columns += ["network, measured + synthetic", "change", "matched field", "network, all measured"]
    return markdown(columns, rows)


WALLS = {  # offset of each wall [m] along -x, +x, -y, +y, -z, +z
    "newrf-bedroom": (-2.28, 2.28, -2.28, 2.28, 0.0, 3.0),
    "newrf-office": (0.010, 5.010, 0.016, 8.016, 0.0, 3.2),
    "newrf-conference": (-1.5, 1.5, -1.5, 1.5, 0.0, 2.5),
    "simulated-room": (0.0, 6.0, 0.0, 5.0, 0.0, 3.0),
}
PARALLEL = 0.9  # cosine between a wall's normal and a plane's, above which it may be that wall


def room() -> str:
    """Return the largest error of the planes that each run found, where the true ones are known."""
    rows = []
    for share, mix, result in aoa_shares():
        found, walls = result.get("geometry", {}).get(share), WALLS.get(result["metrics"]["data"])
        if found is None or walls is None:
            continue
        errors = [_error_mm(found["planes"], *wall) for wall in enumerate(walls)]
        near = [error for error in errors if error is not None]
        certain = sum(plane["certain"] for plane in found["planes"])
        scene = f"{result['metrics']['data']}, {result['metrics']['moving']}"
        cells = [f"{len(near)} of {len(walls)}", f"{max(near):.1f}", f"{certain} of {len(found['planes'])}"]
        rows.append([scene, str(mix["n_measured"]), *cells])
    return markdown(["scene, moving end", "spectra", "walls found", "largest error [mm]", "identifiable"], rows)


def _error_mm(planes: list[dict[str, Any]], side: int, offset: float) -> float | None:
    """Return the error of the plane nearest to a true wall on that side of the room, None without a plane."""
    outward = 1 if side % 2 else -1
    own = [outward * plane["offset_m"] for plane in planes if outward * plane["normal"][side // 2] > PARALLEL]
    return min((1000 * abs(found - offset) for found in own), default=None)


def locating_spectra() -> str:
    """Return position errors of matched-field processing, medians over the draws."""
    rows = []
    for name in SPECTRA:
        for scene, fractions in load(name).get("scenes", {}).items():
            for fraction, entry in fractions.items():
                found, n = entry["median"], str(len(entry["draws"]))
                error = f"{found['position_m']['median']:.3f} / {found['position_m']['p90']:.3f}"
                rows.append([scene, f"{float(fraction):.0%}", n, error, f"{found['coverage_80']:.0%}"])
    return markdown(["scene", "measured", "random choices", "position [m]", "80 % regions hold"], rows)


def stations() -> str:
    """Return position errors by several stations, by the best single one, and of the baselines, medians over the draws."""
    rows = []
    for name in ("stations", "stations_rooms", "stations_rooms_spectra"):
        for scene, entry in load(name).get("scenes", {}).items():
            found, n = entry["median"], len(entry["draws"])
            methods = {"best": found["best_station_m"], **found["position_m"]}
            kinds = ("best", "knn", "triangulation", "triangulation_matched", "posterior")
            cells = [f"{methods[kind]['median']:.3f} / {methods[kind]['p90']:.2f}" for kind in kinds]
            rows.append([scene, str(n), *cells, f"{found['coverage_80']:.0%}", f"{found['locate_ratio']:.1f}"])
    heads = [
        "scene",
        "random choices",
        "best single array [m]",
        "nearest spectra of all [m]",
        "triangulation of peaks [m]",
    ]
    heads += ["triangulation of matched fields [m]", "all three arrays [m]", "80 % regions hold", "time of one array"]
    return markdown(heads, rows)


def best_other(row: dict[str, Any]) -> tuple[str, float]:
    """Return the estimator of smallest median error beside matched-field processing, and this error [deg]."""
    ending = "_angle_deg"
    errors = {key.removesuffix(ending): float(row[key]["median"]) for key in row if key.endswith(ending)}
    best = min(errors, key=errors.__getitem__)
    return best.replace("_", " "), errors[best]


def channels() -> str:
    """Return errors of matched fields on channels, and coherence and errors of channels predicted at unseen positions."""
    rows = []
    files = sorted(RESULTS.glob("channels_*.json"))  # channels_ and the number of subcarriers, then perhaps the scene
    for name, scene, fractions in [(f.stem, *item) for f in files for item in load(f.stem)["scenes"].items()]:
        for fraction, found in fractions.items():
            row = found["median"]
            error = [f"{row[key]['median']:.2g} / {row[key]['p90']:.2g}" for key in ("angle_deg", "position_m")]
            predicted = [
                f"{own['coherence']:.2f}" + (f" / {own['nmse_db']:+.1f}" if "nmse_db" in own else "")
                for name in ("nearest", "gaussian_process", "planes", "furniture")
                if (own := row["channel"].get(name))
            ]
            what = [scene, f"{float(fraction):.0%}", name.split("_")[1], str(len(found["draws"]))]
            other = ""
            if "peak_angle_deg" in row:
                best, least = best_other(row)
                other = f"{least:.2g} ({best})"
            rows.append([*what, *error, other, f"{row['coverage_80']:.0%}", *predicted])
    columns = ["scene", "measured", "subcarriers", "draws", "angle [deg]", "position [m]", "best other angle [deg]"]
    predictors = ["nearest", "Gaussian process", "planes", "planes and furniture"]
    return markdown([*columns, "80 % regions hold", *predictors], rows)
