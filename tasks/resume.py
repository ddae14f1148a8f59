"""Command line and inputs that an interrupted run saved at its start. Importable without torch."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from swiftwrf.errors import InputError
from swiftwrf.runtime.durable import strict
from tasks.claim import CONFIG, ENVIRONMENT
from tasks.records import Row, read_json

PARTIAL = ".partial"  # suffix of a run that is not finished


def interrupted(folder: Path) -> Row:
    """Return the content of an interrupted run's configuration file: task, command and config.

    Raises:
        InputError: There is no interrupted run, or it stopped before it wrote its configuration.
    """
    if not folder.name.endswith(PARTIAL) or not folder.is_dir():
        raise InputError(f"{folder} is no interrupted run; expected a directory *{PARTIAL} with a {CONFIG}")
    if not (folder / CONFIG).exists():
        raise InputError(
            f"{folder} was stopped before its {CONFIG} was written, so it holds nothing to go on with; start the run again"
        )
    return read_json(folder / CONFIG)


def saved_config(folder: Path, task: str) -> Row:
    """Return the configuration of an interrupted run.

    Raises:
        InputError: There is no such run, it is of another task, or its configuration has changed since it began.
    """
    content = interrupted(folder)
    if content.get("task") != task:
        raise InputError(
            f"{folder} is a run of tasks.{content.get('task')}; resume it with that task, not tasks.{task}"
        )
    if digest(content.get("config")) != read_json(folder / ENVIRONMENT).get("config_sha256"):
        raise InputError(
            f"{folder / CONFIG} is not what the run began with, and its steps would mix two configurations; restore it or "
            "start a new run"
        )
    config: Row = content["config"]
    return config


def digest(config: Any) -> str:
    """Return the SHA-256 of a configuration of plain values."""
    return hashlib.sha256(json.dumps(strict(config), sort_keys=True).encode()).hexdigest()
