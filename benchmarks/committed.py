"""Committed results, read back with the types of their metrics, and tables in Markdown."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tasks.metrics import AoaMetrics, ErrorSummary, RssiMetrics

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"


def load(name: str) -> dict[str, Any]:
    """One result."""
    content: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text())
    return content


def aoa_runs() -> list[AoaMetrics]:
    """Metrics of all runs of tasks.aoa, by file name."""
    return [load(file.stem)["metrics"] for file in sorted(RESULTS.glob("aoa_*.json"))]


def rssi_runs() -> list[RssiMetrics]:
    """Metrics of all runs of tasks.rssi, by file name."""
    return [load(file.stem)["metrics"] for file in sorted(RESULTS.glob("rssi_*.json"))]


def markdown(columns: list[str], rows: list[list[str]]) -> str:
    """The table in Markdown."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def interval(error: ErrorSummary) -> str:
    """Median with its 95 % interval."""
    return f"{error['median']:.2f} [{error['low']:.2f}, {error['high']:.2f}]"
