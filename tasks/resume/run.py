"""Continue an interrupted run with the options that it saved at its start."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from swiftwrf.errors import InputError
from tasks.claim import CONFIG, ENVIRONMENT
from tasks.command import COMMANDS, run_task
from tasks.command_line import parse
from tasks.directory import digest
from tasks.records import read_json
from tasks.resume.options import ResumeConfig

CHANGING = ("scheduler", "processes")  # options of a run that may change when it is resumed


def run(config: ResumeConfig) -> None:
    """Compute the steps of a run that are missing, and finish it.

    Raises:
        InputError: The configuration of the run has changed since it began.
    """
    folder, content = Path(config.run), config.saved()
    task, saved = content["task"], content["config"]
    if digest(saved) != read_json(folder / ENVIRONMENT).get("config_sha256"):
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
