"""Continue an interrupted run with the options that it saved at its start."""

from __future__ import annotations

from pathlib import Path

from swiftwrf.errors import InputError
from swiftwrf.runtime.digest import digest
from tasks import configs
from tasks.command import COMMANDS, run_module, run_task
from tasks.command_line import parse
from tasks.configs import ResumeConfig
from tasks.records import CONFIG, ENVIRONMENT, read_json


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
    changing = ("scheduler", "processes")
    given = {name: value for name in changing if (value := getattr(config, name)) is not None}
    arguments = [text for name, value in given.items() for text in (f"--{name}", str(value))]
    saved = {name: value for name, value in saved.items() if name not in changing}
    resumed = parse(getattr(configs, COMMANDS[task].options), arguments, "swiftwrf resume", saved, folder)
    resumed.check()
    run_task(task, resumed, folder)


if __name__ == "__main__":
    raise SystemExit(run_module("tasks.resume"))
