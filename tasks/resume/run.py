"""Continue an interrupted run with the options that it saved at its start."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from swiftwrf.errors import InputError
from tasks.claim import CONFIG, ENVIRONMENT, PARTIAL
from tasks.command import COMMANDS, run_task
from tasks.command_line import parse
from tasks.directory import digest
from tasks.records import Row, read_json
from tasks.resume.options import ResumeConfig

RESUMABLE = ("aoa", "rssi", "locate")
CHANGING = ("scheduler", "processes")  # options of a run that may change when it is resumed


def run(config: ResumeConfig) -> None:
    """Compute the steps of a run that are missing, and finish it.

    Raises:
        InputError: There is no such run, or its configuration has changed since it began.
    """
    folder = Path(config.run)
    content = _interrupted(folder)
    task, saved = content.get("task"), content.get("config")
    if task not in RESUMABLE:
        raise InputError(f"{folder} is a run of the unknown task {task!a}; restore its {CONFIG}")
    if not isinstance(saved, dict) or digest(saved) != read_json(folder / ENVIRONMENT).get("config_sha256"):
        raise InputError(
            f"{folder / CONFIG} is not what the run began with, and its steps would mix two configurations; restore it or "
            "start a new run"
        )
    given = {name: value for name in CHANGING if (value := getattr(config, name)) is not None}
    arguments = [text for name, value in given.items() for text in (f"--{name}", str(value))]
    saved = {name: value for name, value in saved.items() if name not in CHANGING}
    config_type = getattr(import_module(f"tasks.{task}.options"), COMMANDS[task].options)
    resumed = parse(config_type, arguments, "swiftwrf resume", saved, folder)
    resumed.check()
    run_task(task, resumed, folder)


def _interrupted(folder: Path) -> Row:
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
