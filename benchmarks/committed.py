"""Read committed results with the types of their metrics, and format tables in Markdown."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from augment.turbo.condition import Condition, conditions_of, headline
from augment.turbo.results import MixMetrics
from swiftwrf.metrics import ChangeMetrics, ErrorSummary
from tasks.metrics import AoaMetrics

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"


def load(name: str) -> dict[str, Any]:
    """Return one result."""
    content: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text())
    return content


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
    return headline(conditions_of(mix["methods"]).values())


def change_text(found: ChangeMetrics) -> str:
    """Return a change with its interval."""
    return f"{found['change']:+.0%} [{found['low']:+.0%}, {found['high']:+.0%}]"


def markdown(columns: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def interval(error: ErrorSummary) -> str:
    """Return a median with its 95 % interval as text."""
    return f"{error['median']:.2f} [{error['low']:.2f}, {error['high']:.2f}]"
