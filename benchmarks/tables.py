"""The README's tables from the committed results: python benchmarks/tables.py rewrites them in place."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"


def _load(name: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text())
    return content


def _table(columns: list[str], rows: list[list[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def synthesis() -> str:
    """Median SSIM and PSNR of each synthesizer on each scene."""
    rows = []
    for scene, result in _load("synthesis")["scenes"].items():
        scores = result["synthesizers"]
        cells = [f"{s['ssim']['median']:.3f} / {s['psnr_db']['median']:.1f}" for s in scores.values()]
        rows.append([scene, *cells, f"{scores['swiftwrf']['seconds']['fit']:.0f} s"])
    return _table(["scene, split", "mean", "nearest", "idw", "gp", "swiftwrf", "fit"], rows)


def aoa() -> str:
    """Median great-circle errors of the arms of each run."""
    methods = ("constant", "nearest_spectrum", "measured_only", "turbo_swiftwrf", "measured_all")
    rows = []
    for file in sorted(RESULTS.glob("aoa_*.json")):
        metrics = json.loads(file.read_text())["metrics"]
        for share, mix in metrics["mixes"].items():
            errors = [mix["methods"][name]["great_circle_deg"] for name in methods]
            cells = [f"{e['median']:.2f} [{e['low']:.2f}, {e['high']:.2f}]" for e in errors]
            rows.append([f"{metrics['data']}, {metrics['split']}", f"{float(share):.0%}", *cells])
    return _table(["scene, split", "measured", *methods], rows)


def rssi() -> str:
    """Median and 90 % of the absolute errors of each predictor, and the interval's coverage."""
    methods = ("mean", "mri_pooled", "mri_receiver", "mri_residual", "knn", "gp", "swiftwrf")
    rows = []
    for file in sorted(RESULTS.glob("rssi_*.json")):
        metrics = json.loads(file.read_text())["metrics"]
        errors = [metrics["overall"][name]["abs_error_db"] for name in methods]
        cells = [f"{e['median']:.2f} / {e['p90']:.1f}" for e in errors]
        rows.append([f"{metrics['data']}, {metrics['split']}", *cells, f"{metrics['interval']['coverage']:.0%}"])
    return _table(["data, split", *methods, "80 % interval covers"], rows)


TABLES = {"synthesis": synthesis, "aoa": aoa, "rssi": rssi}


def rewrite(text: str) -> str:
    """The text with each block between `<!-- NAME -->` and `<!-- /NAME -->` replaced by its table."""
    for name, table in TABLES.items():
        block = f"<!-- {name} -->\n{table()}\n<!-- /{name} -->"
        text = re.sub(rf"<!-- {name} -->.*?<!-- /{name} -->", lambda _, block=block: block, text, flags=re.DOTALL)
    return text


if __name__ == "__main__":
    readme = ROOT / "README.md"
    readme.write_text(rewrite(readme.read_text()))
