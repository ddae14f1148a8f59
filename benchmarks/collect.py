"""Copy the metrics of a finished run into the results: python benchmarks/collect.py RUN NAME."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import Any

from record import without_folders

from tasks.records import Records


def collect(folder: Path, name: str) -> None:
    """Write command, environment, metrics and rooms of the run to `results/NAME.json`."""
    run = Records(folder)
    command = without_folders(shlex.split(run.config["command"]))
    content: dict[str, Any] = {"command": command, "environment": run.environment, "metrics": run.metrics}
    rooms = {
        file.stem.removeprefix("geometry-mix"): json.loads(file.read_text())
        for file in sorted(folder.glob("geometry-mix*.json"))
    }
    if rooms:
        content["geometry"] = rooms
    file = Path(__file__).parent / "results" / f"{name}.json"
    file.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    print(f"wrote {file}")


if __name__ == "__main__":
    collect(Path(sys.argv[1]), sys.argv[2])
