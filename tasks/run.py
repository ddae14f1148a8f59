"""Running a task: from the command line to a configuration, from errors to sentences and exit codes."""

from __future__ import annotations

import errno
import inspect
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar
from unicodedata import category

import torch
import tyro

from swiftwrf import FitError, InputError
from swiftwrf.errors import one_line
from swiftwrf.runtime.registry import Registry
from tasks.directory import Run, console, saved_config
from tasks.records import Row
from tasks.torchrun import check_gpus, together

Config = TypeVar("Config")
Preset = Literal["quick", "paper"]
SEEDS = 2**32  # number of seeds that the generators of scikit-learn and NumPy accept
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def command_line(
    name: str,
    config_type: type[Config],
    task: Callable[..., None],
    arguments: Sequence[str],
    program: str | None = None,
) -> int:
    """Run a task with the options of a command line; see `execute` and `exit_code`."""
    return exit_code(partial(execute, name, config_type, task, arguments, program))


def exit_code(action: Callable[[], None]) -> int:
    """Return the exit code of an action and print its error as one sentence. Under torchrun the first process acts.

    Returns:
        0: done. 1: a fit failed. 2: wrong input, or a file that cannot be written. 130: interrupted.
    """
    return together(partial(_exit_code, action))


def _exit_code(action: Callable[[], None]) -> int:
    try:
        action()
    except InputError as error:
        return _report(str(error), 2)
    except FitError as error:
        return _report(str(error), 1)
    except OSError as error:  # readers raise InputError, so this is about writing
        return _report(_not_written(error), 2)
    except MemoryError as error:
        return _report(f"not enough memory ({error}); use less data or a smaller model", 2)
    except KeyboardInterrupt:
        return 130
    return 0


def _report(sentence: str, code: int) -> int:
    print(f"error: {one_line(sentence)}", file=sys.stderr)
    return code


def _not_written(error: OSError) -> str:
    file = error.filename2 or error.filename or "the run's files"
    if error.errno in DISK_FULL:
        return f"no space left to write {file}; make room and go on with --resume, or choose another --out"
    reason = "no permission" if isinstance(error, PermissionError) else error.strerror or str(error)
    return f"cannot write {file} ({reason}); choose another --out"


def execute(
    name: str,
    config_type: type[Config],
    task: Callable[..., None],
    arguments: Sequence[str],
    program: str | None = None,
) -> None:
    """Parse a command line and run the task.

    A task that can be resumed takes a second argument, `resume`. For such a task `--resume DIR` takes the configuration of
    an interrupted run, and `--scheduler ADDRESS` after it continues the run on a cluster.

    Args:
        name: Module of the task, e.g. tasks.aoa.
        config_type: Dataclass of the options. Its docstring is the description in the help.
        task: Function of the configuration and, if it can be resumed, of the directory to resume or None.
        arguments: Options of the command line.
        program: Name of the command in the help. Defaults to `python -m NAME`.

    Raises:
        InputError: Wrong options, or the error of the task.
    """
    resumable, values, folder = "resume" in inspect.signature(task).parameters, None, None
    match arguments:
        case ["--resume", *_] if not resumable:
            raise InputError(f"a run of {name} cannot be resumed; start it again")
        case ["--resume", resumed, *place] if not place or (place[0] == "--scheduler" and len(place) == 2):
            folder = Path(resumed)
            values = saved_config(folder, name.removeprefix("tasks.")) | {"scheduler": place[1] if place else None}
            config = configured(config_type, values, folder)
        case ["--resume", *_]:
            raise InputError(
                "--resume takes one directory, and --scheduler to use a cluster; no other option can change"
            )
        case _:
            description = inspect.cleandoc(config_type.__doc__ or "")
            config = tyro.cli(config_type, prog=program or f"python -m {name}", description=description, args=arguments)
    _check_values(config)
    if resumable:
        task(config, folder)
    else:
        task(config)


def configured(config_type: type[Config], values: Row, folder: Path) -> Config:
    """Return the configuration that a run has kept as plain values.

    Raises:
        InputError: The values are of another version of the command.
    """
    try:
        return config_type(**{key: tuple(v) if isinstance(v, list) else v for key, v in values.items()})
    except TypeError as error:
        raise InputError(f"{folder} was begun by another version of this command ({error}); start a new run") from None


def _check_values(config: Any) -> None:
    """Refuse empty text, control characters, numbers that are not finite, and seeds that generators do not accept.

    Raises:
        InputError: The first such option.
    """
    for option in fields(config):
        flag, given = f"--{option.name.replace('_', '-')}", getattr(config, option.name)
        for value in given if isinstance(given, tuple) else (given,):
            if value == "":
                raise InputError(f"{flag} is empty; give it a value or leave it out")
            if isinstance(value, str) and any(category(letter) in ("Cc", "Cs") for letter in value):
                raise InputError(f"{flag} {value!a} holds control characters or is not UTF-8; give it another value")
            if isinstance(value, float) and not math.isfinite(value):
                raise InputError(f"{flag} takes finite numbers, got {value}")
        if option.name == "seed" and not 0 <= given < SEEDS:
            raise InputError(f"--seed must be from 0 to {SEEDS - 1}, got {given}")


def choice(meaning: str, registry: Registry[Any], known: Mapping[str, Any] | None = None) -> Any:
    """Return the annotation of an option that takes names of a registry. Its help lists the registered names.

    Args:
        meaning: Meaning of the option.
        registry: Registry of the names.
        known: Labels with a `meaning` by name. Other names have the first line of their docstring.
    """

    def entries(default: str) -> str:
        meanings = {
            name: known[name].meaning if known and name in known else registry.summary(name) for name in registry
        }
        return f"{'; '.join(f'{name}: {text}' for name, text in meanings.items())} (default: {default})"

    return tyro.conf.arg(help=f"{meaning}:", help_behavior_hint=entries)


def choose_device(name: str) -> torch.device:
    """Return the device of that name. With `auto` it is the GPU if there is one.

    Raises:
        InputError: There is no GPU, or there are fewer GPUs than processes of torchrun.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda needs an NVIDIA GPU that torch can use, and there is none; use --device cpu")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda":
        check_gpus()
    return torch.device(name)


__all__ = [
    "SEEDS",
    "Preset",
    "Row",
    "Run",
    "choice",
    "choose_device",
    "command_line",
    "console",
    "execute",
    "exit_code",
]
