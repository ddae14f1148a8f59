"""Write the result of a benchmark with the command and the machine that measured it."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from tasks.environment import environment

RESULTS = Path(__file__).parent / "results"


def without_folders(command: Sequence[str]) -> str:
    """Return a command whose words name no folders of this machine."""
    return shlex.join(Path(word).name if "/" in word else word for word in command)


def write_result(
    name: str, content: dict[str, Any], device: torch.device | None = None, folder: Path = RESULTS
) -> None:
    """Write `NAME.json` into the folder, as strict JSON with the command and the environment of `device` (default: CPU)."""
    folder.mkdir(parents=True, exist_ok=True)
    record = {
        "command": without_folders(["python", *sys.argv]),
        "environment": environment(device or torch.device("cpu"), {}),
        **content,
    }
    file = folder / f"{name}.json"
    file.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n")
    print(f"wrote {file}")
