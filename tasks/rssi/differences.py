"""The table of the report that shows where methods differ: weak and strong values, far positions, few rows, a region."""

from __future__ import annotations

from tasks.page.page import Table, number
from tasks.records import Records
from tasks.rssi.maps import Maps
from tasks.terminal import Answer


def where_methods_differ(run: Records, found: Answer) -> Table:
    """Return the errors of all methods at weak and strong values, far from training rows, with few rows, and in a region."""
    errors, unit, error_unit = run.table("errors"), Maps(run).unit, Maps(run).error_unit
    errors = errors.assign(error=errors["predicted_dbm"] - errors["measured_dbm"])
    pairs = errors[errors["method"] == found.chosen]  # which are those of all methods
    weak, strong = pairs["measured_dbm"].quantile([0.25, 0.75])
    apart = float(pairs["from_training_m"].quantile(0.75))
    by_method = {
        f"{end} quarter, {sign} {value:.4g} {unit}: bias [{error_unit}]": errors[part].groupby("method")["error"].mean()
        for end, sign, value, part in (
            ("weakest", "up to", weak, errors["measured_dbm"] <= weak),
            ("strongest", "from", strong, errors["measured_dbm"] >= strong),
        )
    }
    far = errors[errors["from_training_m"] >= apart]
    by_method[f"{apart:.2g} m or more from training rows [{error_unit}]"] = far.groupby("method")["abs_error_db"].mean()
    rows, region = run.metrics["by_rows"], run.metrics["region"]
    if len(rows) > 1:
        fewest = min(rows, key=int)
        by_method[f"fitted to {fewest} of {run.metrics['n_train']} rows [{error_unit}]"] = rows[fewest]
    if region:
        by_method[f"in a region without rows [{error_unit}]"] = region
    cells = [
        [one.name, *(_cell(values.get(one.name), is_bias="bias" in column) for column, values in by_method.items())]
        for one in found.methods
    ]
    caption = (
        "Bias: mean of predicted less measured values. Values are also weak or strong by chance, so every method is too "
        "strong at the weakest and too weak at the strongest. All other columns are mean absolute errors. The region is a "
        "fifth of the area, which methods predict by the training rows elsewhere."
    )
    return Table(["method", *by_method], cells, caption, frozenset([found.chosen]))


def _cell(value: float | None, is_bias: bool) -> str:
    return f"{value:+.1f}" if is_bias and value is not None else number(value)
