"""Tables of measured RSSI, and of locating: matched fields on spectra, localizers on RSSI."""

from __future__ import annotations

import math
import operator
from statistics import mean
from typing import Any

from record import load, markdown

ANY, TWO = "any receiver", "two receivers"  # rows that are of no single receiver
Row = dict[str, Any]
COVERED_DBM = -75.0  # threshold of the reports
RELEVANT_DB = 0.02  # difference of medians below which predictors are level


def rssi_glance() -> str:
    """Return the model of each split beside its best baseline: medians, paired differences and coverage."""
    rows = []
    for name, found in load("rssi")["sets"].items():
        methods, best = found["methods"], found["best_baseline"]
        baseline = methods[best]["abs_error_db"]["median"]
        model = found["model"]
        own = methods[model]
        difference = own["difference_db"]["median"]
        rows.append(
            [
                name,
                f"{found['n_train']} / {found['n_test']}",
                f"`{best}` {baseline:.2f}",
                f"`{model}` {own['abs_error_db']['median']:.2f}",
                f"{difference:+.2f}, {_outcome(difference)}",
                _interval(own["difference_db"]),
                f"{own['coverage']:.0%}",
            ]
        )
    columns = ["data, split", "training / test rows", "best baseline", "model", "difference of medians"]
    return markdown([*columns, "mean difference [95 %]", "80 % interval covers"], rows)


def coverage_headline() -> str:
    """Return the predicted and the counted shares of test scans with a receiver above -75 dBm, and where it is certain."""
    found: dict[str, list[Row]] = {}
    for name, scene in load("coverage_headline").get("scenes", {}).items():
        floors = "simulated floors random" if name.startswith("simulated-floor") else name
        found.setdefault(floors, []).extend(scene["rows"])
    rows = []
    for name, every in found.items():
        own = [row for row in every if row["threshold_dbm"] == COVERED_DBM]
        n = sum(row["n"] for row in own)
        predicted, above = (sum(row["n"] * row[key] for row in own) / n for key in ("predicted", "above"))
        worst = max((100 * (row["predicted"] - row["above"]) for row in own), key=abs)
        sure = [row for row in every if row["n_certain"]]
        n_sure = sum(row["n_certain"] for row in sure)
        passed = sum(row["n_certain"] * row["certain_above"] for row in sure) / n_sure if sure else None
        cells = [str(len(own)), str(n), f"{predicted:.0%}", f"{above:.0%}", f"{round(worst, 1) + 0.0:+.1f}"]
        rows.append([name, *cells, "" if passed is None else f"{passed:.1%} of {n_sure}"])
    columns = ["data, split", "floors", "scans", "predicted", "counted", "largest difference of a floor [points]"]
    return markdown([*columns, "pass where P is 0.9 or more, all thresholds"], rows)


def coverage_receivers() -> str:
    """Return how often predicted shares of test scans are within 5 points of the counted ones, by floor and receiver.

    A counted share of n scans has a standard error. Shares count as within 5 points up to two of it, too.
    """
    found: dict[str, list[Row]] = {}
    for name, scene in load("coverage_receivers").get("scenes", {}).items():
        floors = "simulated floors random" if name.startswith("simulated-floor") else name
        found.setdefault(floors, []).extend(scene["rows"])
    rows = []
    for name, every in found.items():
        cells = []
        for own in (
            [row for row in every if row["receiver"] == ANY],
            [row for row in every if row["receiver"] not in (ANY, TWO)],
        ):
            off = [abs(row["test_predicted"] - row["test_above"]) for row in own]
            by_chance = [
                max(0.05, 2 * math.sqrt(row["test_predicted"] * (1 - row["test_predicted"]) / row["n_test"]))
                for row in own
            ]
            within = sum(error <= 0.05 for error in off), sum(map(operator.le, off, by_chance))
            bias = mean(row["test_predicted"] - row["test_above"] for row in own)
            cells += [f"{within[0]} of {len(own)}", f"{within[1]} of {len(own)}", f"{100 * bias + 0.0:+.1f}"]
        rows.append([name, *cells])
    heads = ("within 5 points", "or two standard errors", "mean difference [points]")
    columns = [f"{who}: {head}" for who in ("any receiver", "each receiver") for head in heads]
    return markdown(["data, split", *columns], rows)


def intervals() -> str:
    """Return the mean and the least coverage of the 80 % intervals and regions, of the runs of each study."""
    rows = []
    for name, found in load("intervals").get("rows", {}).items():
        rows.append([name, str(len(found["coverage"])), f"{found['mean']:.0%}", f"{found['least']:.0%}"])
    return markdown(["study: data, split, what", "runs", "mean coverage", "least"], rows)


def not_detected() -> str:
    """Return the errors of maps below the limit of detection, with empty cells as limits and without."""
    rows = []
    for kind, what in (("auto", "upper limits where they are those of weak signals"), ("unknown", "ignored")):
        found = [row for row in load("not_detected")["rows"] if row["not_detected"] == kind]
        bias, above, error = (
            [row[key] for row in found] for key in ("weak_bias_db", "weak_above_limit", "strong_error_db")
        )
        cells = [
            f"{mean(bias):+.1f} ({min(bias):+.1f} to {max(bias):+.1f})",
            f"{mean(above):.0%}",
            f"{mean(error):.2f}",
        ]
        rows.append([what, *cells])
    columns = [
        "empty cells",
        "bias of weak cells [dB], mean (range)",
        "weak cells above the limit",
        "error elsewhere [dB]",
    ]
    return markdown(columns, rows)


def survey_receivers() -> str:
    """Return errors of estimated positions of receivers in plan beside baselines, and how many regions hold."""
    found, rows = load("survey_receivers").get("sets", {}), []
    for name, one in found.items():
        errors = {kind: one[f"{kind}_m"] for kind in ("strongest", "centroid", "estimate")}
        cells = [f"{error['median']:.2f} / {error['p90']:.2f}" for error in errors.values()]
        ratio = f"{errors['estimate']['median'] / errors['strongest']['median']:.2f}"
        rows.append([name, str(one["n"]), *cells, ratio, f"{one['hold']} of {one['n']}", f"{one['radius_m']:.1f}"])
    n, hold = (sum(one[key] for one in found.values()) for key in ("n", "hold"))
    rows.append(["all", str(n), "", "", "", "", f"{hold} of {n}", ""])
    columns = [
        "data",
        "receivers",
        "strongest row [m]",
        "weighted centroid [m]",
        "estimate [m]",
        "over the strongest row",
    ]
    return markdown([*columns, "80 % regions hold", "median radius [m]"], rows)


def survey_plan() -> str:
    """Return the regret of places for a further access point on simulated floors."""
    floors = load("survey_plan").get("floors", [])
    rows = []
    for kind, what in (
        ("chosen", "`swiftwrf plan`"),
        ("hole", "centre of the largest hole"),
        ("random", "random place (mean of all)"),
    ):
        regret = [100 * (floor["best"] - floor[kind]) for floor in floors]
        rows.append([what, f"{mean(regret):.1f}", f"{min(regret):.1f} to {max(regret):.1f}"])
    return markdown(["place", "regret of coverage, mean [points]", "of single floors"], rows)


def survey_gains() -> str:
    """Return predicted and true gains of coverage on simulated floors."""
    floors = load("survey_plan").get("floors", [])
    rows = []
    for what, *names in (
        ("chosen place", "predicted_gain", "true_gain", "true_gain_like_surveyed"),
        ("all places", "predicted_gain_of_all", "true_gain_of_all", None),
    ):
        rows.append([what, *(f"{100 * mean(floor[name] for floor in floors):.1f}" if name else "" for name in names)])
    hold = f"{mean(floor['intervals_hold'] for floor in floors):.0%}"
    rows.append(["80 % intervals that hold", hold, "", ""])
    power = "true, with the mean power of the surveyed ones"
    return markdown(["gain of coverage [points]", "predicted", "true", power], rows)


def survey_left_out() -> str:
    """Return errors of RSSI that is predicted at a receiver from the path loss of all others."""
    rows = [
        [
            name,
            str(one["receivers"]),
            f"{one['median_db']:.1f}",
            f"{one['intervals_hold']:.0%}",
            f"{100 * one['share_error']:.0f}",
        ]
        for name, one in load("survey_plan").get("left_out", {}).items()
    ]
    columns = ["data", "receivers", "median absolute error [dB]", "80 % intervals hold"]
    return markdown([*columns, "share of rows above the median RSSI: median error of a receiver [points]"], rows)


def _outcome(difference_db: float) -> str:
    if abs(difference_db) <= RELEVANT_DB:
        return "level"
    return "ahead" if difference_db < 0 else "behind"


def _interval(difference: dict[str, Any]) -> str:
    return f"{difference['mean']:+.2f} [{difference['low']:+.2f}, {difference['high']:+.2f}]"


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
    sets = {name: one for name, one in load("locating_rssi")["sets"].items() if name.split()[0] not in PUBLISHED}
    rows, names = [], list(dict.fromkeys(n for one in sets.values() for n in one["localizers"]))
    for name, measured in sets.items():
        errors = {n: entry["position_error_m"] for n, entry in measured["localizers"].items()}
        cells = [f"{errors[n]['median']:.2f} / {errors[n]['p90']:.2f}" if n in errors else "" for n in names]
        coverage = measured["coverage"]["0.8"]
        rows.append([name, str(next(iter(errors.values()))["n"]), *cells, f"{coverage:.0%}"])
    return markdown(["data, split", "test rows", *names, "80 % regions hold"], rows)
