"""Findings on RSSI: its values, and whether it decreases with distance."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from swiftwrf.data import Rssi
from swiftwrf.data.columns import has_frequent_edge
from swiftwrf.data.splits import MIN_TRAINING
from swiftwrf.diagnostics.path_loss import check_path_loss
from swiftwrf.errors import listed
from swiftwrf.rssi import estimate_offsets
from tasks.inspect.findings.base import Findings
from tasks.inspect.findings.positions import add_splits, check_positions

MAX_LEVEL_DBM = 10.0  # at 1 m, which no usual transmitter reaches
MIN_EXPLAINED, MIN_SPREAD_DB = 0.15, 1.0  # of offsets that are proposed


def check_rssi(data: Rssi, findings: Findings) -> None:
    """Report number, range and suspicious columns of RSSI."""
    detected = data.detected
    share = float(detected.double().mean())
    low, high = float(data.rssi_dbm[detected].min()), float(data.rssi_dbm[detected].max())
    findings.add(
        f"{len(data)} rows of RSSI at {len(data.receiver_names)} receivers, {share:.0%} detected, {low:g} to {high:g} dBm.",
        kind="rssi",
        receivers=len(data.receiver_names),
        detected_fraction=share,
    )
    check_positions(data.transmitter_position, findings)
    count = detected.sum(dim=0)
    few = [name for name, n in zip(data.receiver_names, count.tolist(), strict=True) if n < MIN_TRAINING]
    if few:
        findings.warn(f"Receivers that detected fewer than {MIN_TRAINING} rows, too few to fit a model: {listed(few)}.")
    _columns(data, detected, findings)
    _path_loss(data, findings)
    add_splits(data, findings)


def propose_offsets(data: Rssi, findings: Findings) -> None:
    """Warn of a column whose values have constant offsets of RSSI.

    Args:
        data: RSSI with the groups of such a column.
        findings: Where the warning is added.
    """
    if data.groups is None or len(data.groups.code.unique()) < 2:
        return
    column = data.groups.column
    offsets = estimate_offsets(data)
    spread = max(offsets.offset_db.values()) - min(offsets.offset_db.values())
    if offsets.explained < MIN_EXPLAINED or spread < MIN_SPREAD_DB:
        return
    findings.warn(
        f"Offsets of up to {spread:.1f} dB between the values of column {column} explain {offsets.explained:.0%} of the "
        f"variance about a smooth field; --offset-by {column} estimates them.",
        **{f"offsets_explained_{column}": offsets.explained},
    )


def _columns(data: Rssi, detected: Tensor, findings: Findings) -> None:
    """Warn of receivers whose values do not look like received power."""

    def those(suspicious: Callable[[Tensor], bool]) -> list[str]:
        columns = ((name, data.rssi_dbm[detected[:, c], c]) for c, name in enumerate(data.receiver_names))
        return [name for name, values in columns if len(values) >= MIN_TRAINING and suspicious(values)]

    if constant := those(lambda v: bool(v.min() == v.max())):
        findings.warn(f"Receivers with one value everywhere: {listed(constant)}.")
    if positive := those(lambda v: bool(v.min() < v.max() and v.max() >= 0)):
        findings.warn(f"Receivers with values of 0 dBm and more, which few receivers measure: {listed(positive)}.")

    if repeated := those(lambda v: has_frequent_edge(v.numpy())):
        findings.warn(
            "The weakest value is far more frequent than those above it; does it mean not detected? Receivers: "
            f"{listed(repeated)}."
        )
    filled = data.rssi_dbm.nan_to_num(0.0)
    same = [
        f"{a} = {b}"
        for i, a in enumerate(data.receiver_names)
        for j, b in enumerate(data.receiver_names[:i])
        if bool((filled[:, i] == filled[:, j]).all())
    ] if len(data.receiver_names) <= 200 else []  # fmt: skip
    if same:
        findings.warn(f"Receivers with the same values: {listed(same)}.")


def _path_loss(data: Rssi, findings: Findings) -> None:
    report = check_path_loss(data.columns(data.receiver_located.nonzero()[:, 0].tolist()))
    if report is None:
        findings.add("The receivers' positions are unknown, so there is no path-loss model; other predictors work.")
        return
    findings.add(
        f"Path-loss models explain {report.explained:.0%} of the variance of RSSI: {report.level_dbm:.0f} dBm at 1 m, "
        f"exponent {report.exponent:.1f}.",
        law_explained=report.explained,
        law_exponent=report.exponent,
    )
    if report.explanation:
        findings.warn(f"It would explain far more if {report.explanation}.", explanation=report.explanation)
    if report.misplaced:
        findings.warn(
            f"Other positions of the receivers would explain {report.attainable:.0%}; no frame that was tried comes close: "
            "are origin, axes and units those of the positions?",
            law_attainable=report.attainable,
        )
    if report.level_dbm > MAX_LEVEL_DBM:
        findings.warn(
            f"{report.level_dbm:.0f} dBm at 1 m is more than usual transmitters give; are positions in millimetres?"
        )
