"""Write the result of a benchmark with the command and the machine that measured it."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import Any

import torch

from tasks.environment import environment

RESULTS = Path(__file__).parent / "results"


def write_result(
    name: str, content: dict[str, Any], device: torch.device | None = None, folder: Path = RESULTS
) -> None:
    """Write `NAME.json` into the folder, as strict JSON with the command and the environment of `device` (default: CPU)."""
    folder.mkdir(parents=True, exist_ok=True)
    command = shlex.join(["python", *(Path(a).name if Path(a).exists() else a for a in sys.argv)])
    record = {"command": command, "environment": environment(device or torch.device("cpu"), {}), **content}
    file = folder / f"{name}.json"
    file.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n")
    print(f"wrote {file}")
