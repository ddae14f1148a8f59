"""Tables of all measured RSSI data sets, from the result of rssi.py."""

from __future__ import annotations

from typing import Any

from committed import load, markdown

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


def rssi_methods() -> str:
    """Return the median and mean absolute error of every predictor on each split."""
    sets = load("rssi")["sets"]
    names = list(dict.fromkeys(name for found in sets.values() for name in found["methods"]))
    rows = []
    for key, found in sets.items():
        errors = {name: entry["abs_error_db"] for name, entry in found["methods"].items()}
        cells = [f"{errors[n]['median']:.2f} / {errors[n]['mean']:.2f}" if n in errors else "" for n in names]
        rows.append([key, *cells])
    return markdown(["data, split", *(f"`{name}`" for name in names)], rows)


def rssi_heads() -> str:
    """Return the errors of the model with the head and with the identity in its place, and the change by the head."""
    rows = []
    for key, found in load("rssi")["sets"].items():
        head, identity = (found["methods"][name]["abs_error_db"] for name in ("swiftwrf", "identity"))
        cells = [f"{error['median']:.2f} / {error['mean']:.2f}" for error in (head, identity)]
        change = " / ".join(f"{head[key] - identity[key]:+.3f}" for key in ("median", "mean"))
        rows.append([key, *cells, change])
    return markdown(["data, split", "with the head", "with the identity", "change by the head"], rows)


def _outcome(difference_db: float) -> str:
    if abs(difference_db) <= RELEVANT_DB:
        return "level"
    return "ahead" if difference_db < 0 else "behind"


def _interval(difference: dict[str, Any]) -> str:
    return f"{difference['mean']:+.2f} [{difference['low']:+.2f}, {difference['high']:+.2f}]"
