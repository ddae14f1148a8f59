"""Names of estimators and keys of metrics.json in runs of earlier versions.

There `kernel_ridge` is kernel regression, and `aann` is kernel regression on the features of the network, not the network
with its own head. A run of an earlier version contains the name `kernel_ridge`.
"""

from __future__ import annotations

import json
from typing import Any

from pandas import DataFrame

FORMER_NAMES = {"kernel_ridge": "kernel_regression", "aann": "aann_kernel"}
FORMER_KEYS = {"advice": "cross_validation", "recommended_extra": "recommended_n_synthetic"}
FORMER_GAIN_KEYS = {"extra": "n_synthetic"}  # of a gain, which was `sampled` or not; the options keep `extra`
(_KERNEL, _PRESENT_KERNEL), (_NETWORK, _PRESENT_NETWORK) = FORMER_NAMES.items()


def with_present_names(values: Any) -> Any:
    """Return plain values of a run with the present names of the estimators and the present keys.

    Example:
        >>> with_present_names({"kernel_ridge_turbo_gp": 1, "turbo_gp": {"estimator": "aann"}})
        {'kernel_regression_turbo_gp': 1, 'turbo_gp': {'estimator': 'aann_kernel'}}
        >>> with_present_names({"turbo_gp": {"estimator": "aann"}})
        {'turbo_gp': {'estimator': 'aann'}}
        >>> gains = [{"extra": 300, "sampled": False}, {"extra": 300, "sampled": True}]
        >>> with_present_names({"advice": {"gp": {"gains": gains}}})
        {'cross_validation': {'gp': {'gains': [{'n_synthetic': 300, 'sampled': False}]}}}
    """
    text = json.dumps(values)
    if _KERNEL in text:
        text = text.replace(_KERNEL, _PRESENT_KERNEL).replace(f'"{_NETWORK}"', f'"{_PRESENT_NETWORK}"')
    return json.loads(text, object_hook=_with_present_keys)


def _with_present_keys(values: dict[str, Any]) -> dict[str, Any]:
    if "gains" in values:
        values["gains"] = [gain for gain in values["gains"] if not gain.get("sampled")]
    keys = FORMER_KEYS | FORMER_GAIN_KEYS if "sampled" in values else FORMER_KEYS
    return {keys.get(key, key): value for key, value in values.items()}


def table_with_present_names(table: DataFrame) -> DataFrame:
    """Return a table of a run with the present names of the estimators."""
    if "method" not in table or not table["method"].astype(str).str.startswith(_KERNEL).any():
        return table
    names = {f"^{_KERNEL}": _PRESENT_KERNEL, f"^{_NETWORK}$": _PRESENT_NETWORK}
    return table.replace({column: names for column in ("method", "estimator") if column in table}, regex=True)
