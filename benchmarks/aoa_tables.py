"""Tables of angle of arrival, and the planes that its runs found."""

from __future__ import annotations

from typing import Any

from geometry import SIDES, WALLS, nearest
from record import RESULTS, interval, load, markdown

from augment.turbo.condition import FULL_NETWORK, LOCATED, MEASURED_NETWORK, Condition, conditions_of
from augment.turbo.condition import headline as chosen
from augment.turbo.results import MixMetrics
from swiftwrf.metrics import ChangeMetrics
from tasks.metrics import AoaMetrics


def aoa_shares() -> list[tuple[str, MixMetrics, dict[str, Any]]]:
    """Return key, metrics and whole result of every measured fraction of every scene, sorted by file name and fraction.

    Of several runs with the same fraction the newest one counts.
    """
    scenes: dict[tuple[str, str, str], dict[str, dict[str, Any]]] = {}
    for file in sorted(RESULTS.glob("aoa_*.json")):
        result = load(file.stem)
        metrics: AoaMetrics = result["metrics"]
        shares = scenes.setdefault((metrics["data"], metrics["split"], metrics["moving"]), {})
        for share in metrics["mixes"]:
            shares[share] = max(shares.get(share, result), result, key=lambda run: str(run["environment"]["end"]))
    return [
        (share, result["metrics"]["mixes"][share], result)
        for shares in scenes.values()
        for share, result in sorted(shares.items())
    ]


def turbo_condition(mix: MixMetrics) -> Condition:
    """Return the network's condition with synthetic spectra that a user would choose."""
    return chosen(conditions_of(mix["methods"]).values())


def change_text(found: ChangeMetrics) -> str:
    """Return a change with its interval."""
    return f"{found['change']:+.0%} [{found['low']:+.0%}, {found['high']:+.0%}]"


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
                median[MEASURED_NETWORK],
                median[turbo.method],
                *(change_text(methods[turbo.method]["changes"][other]) for other in (MEASURED_NETWORK, best)),
                median.get(LOCATED, ""),
                median[FULL_NETWORK],
            ]
        )
    columns = ["scene, split, moving end", "measured", "peak", "constant", "best", "measured only", "turbo"]
    columns += ["against measured only", "against the best", "matched field", "all measured"]
    return markdown(columns, rows)


def headline() -> str:
    """Return the errors in each scene with 30 % of the positions measured."""
    rows = []
    for share, mix, result in aoa_shares():
        if share != "0.3":
            continue
        metrics, methods = result["metrics"], mix["methods"]
        shown = ("peak", "constant", MEASURED_NETWORK, turbo_condition(mix).method, LOCATED, FULL_NETWORK)
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
