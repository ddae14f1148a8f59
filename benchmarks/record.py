"""Write and read results: rows with the command, the commit, the versions and the machine that measured them."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
import tyro

from swiftwrf.contrib.comparison.errors import ErrorSummary
from tasks.environment import environment

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"
CPU = torch.device("cpu")
Options = TypeVar("Options")
loaded: list[str] = []  # names of the results that were read


def options(config_type: type[Options]) -> Options:
    """Return the options of the command line; see `check_committed`."""
    config = tyro.cli(config_type)
    check_committed()
    return config


def check_committed() -> None:
    """Refuse to measure code that no commit contains.

    Raises:
        SystemExit: Uncommitted changes outside of results and docs.
    """
    git = ["git", "status", "--porcelain", "--", ".", ":!benchmarks/results", ":!docs"]
    changed = subprocess.run(git, cwd=ROOT, capture_output=True, text=True, check=False).stdout
    if changed:
        raise SystemExit(f"expected a commit of the measured code, got uncommitted changes; commit them:\n{changed}")


def without_folders(command: Sequence[str]) -> str:
    """Return a command whose words name no folders of this machine."""
    return shlex.join(Path(word).name if "/" in word else word for word in command)


def provenance(device: torch.device = CPU) -> dict[str, Any]:
    """Return the command, the commit, the versions and the machine of a measurement."""
    return _provenance(without_folders(["python", *sys.argv]), environment(device, {}))


def _provenance(command: str, environment: dict[str, Any]) -> dict[str, Any]:
    return {
        "command": command,
        "commit": environment["commit"],
        "date": environment["start"][:10],
        "versions": environment["packages"],
        "machine": environment["device"],
    }


def write_result(
    name: str,
    content: dict[str, Any],
    device: torch.device = CPU,
    folder: Path = RESULTS,
    rows: Iterable[dict[str, Any]] = (),
) -> None:
    """Write `NAME.json` into the folder, as strict JSON.

    Args:
        name: Name of the result.
        content: Result.
        device: Device that measured it.
        folder: Folder of the result.
        rows: Parts of the content that this command measured, where it kept others.
    """
    folder.mkdir(parents=True, exist_ok=True)
    head = {"command": without_folders(["python", *sys.argv]), "environment": environment(device, {})}
    for row in rows:
        row["provenance"] = _provenance(**head)
    file = folder / f"{name}.json"
    file.write_text(json.dumps(head | content, indent=1, allow_nan=False) + "\n")
    print(f"wrote {file}")


def load(name: str) -> dict[str, Any]:
    """Return one result, empty if it was not measured yet."""
    file = RESULTS / f"{name}.json"
    if not file.is_file():
        return {}
    loaded.append(name)
    content: dict[str, Any] = json.loads(file.read_text())
    return content


def origins(name: str) -> list[dict[str, Any]]:
    """Return the provenance of each row of a result, or of the result as a whole if its rows have none."""

    def rows(content: Any) -> Iterator[dict[str, Any]]:
        if isinstance(content, dict):
            yield from [content["provenance"]] if "provenance" in content else []
            content = list(content.values())
        for part in content if isinstance(content, list) else []:
            yield from rows(part)

    content = load(name)
    whole = _provenance(content["command"], content["environment"])
    return [{"date": whole["date"], **row} for row in rows(content)] or [whole]


def age(names: Iterable[str]) -> str:
    """Return when and at which commits results were measured, as a sentence."""
    found = {(row["date"], row["versions"]["swiftwrf-tasks"], row["commit"]) for name in names for row in origins(name)}
    ends = [f"{date} (version {number}, commit {commit})" for date, number, commit in (min(found), max(found))]
    return f"Measured on {ends[0]}." if len(found) == 1 else f"Measured from {ends[0]} to {ends[1]}."


def kept(name: str, key: str) -> Any:
    """Return the parts of a result that were measured before, a list or a dictionary, each with its provenance."""
    content = load(name)
    parts = content.get(key, [])
    for part in parts.values() if isinstance(parts, dict) else parts:
        part.setdefault("provenance", _provenance(content["command"], content["environment"]))
    return parts


def markdown(columns: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def interval(error: ErrorSummary) -> str:
    """Return a median with its 95 % interval as text."""
    return f"{error['median']:.2f} [{error['low']:.2f}, {error['high']:.2f}]"
