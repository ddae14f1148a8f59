"""What runs a task: the command line to a configuration, errors to sentences and exit codes; see `tasks.directory`."""

from __future__ import annotations

import errno
import inspect
import math
import sys
from collections.abc import Callable, Sequence
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
SEEDS = 2**32  # scikit-learn's and NumPy's generators take no larger ones
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def command_line(
    name: str,
    config_type: type[Config],
    task: Callable[[Config, Path | None], None],
    arguments: Sequence[str],
    more: Callable[[], str] | None = None,
) -> int:
    """Parses the arguments into `config_type`, runs the task and turns its errors into sentences and exit codes; under
    torchrun in the first process, for which the others compute.

    `--resume DIR` takes the configuration from an interrupted run instead; where to compute on, here or on the cluster of
    `--scheduler`, is said anew. The help says what the docstring of
    `config_type` does, and `more`.

    Returns:
        0: done; 2: wrong input, or nowhere to write, said in one sentence; 1: a fit that broke; 130: interrupted.
    """
    return together(partial(_command, name, config_type, task, arguments, more))


def _command(
    name: str,
    config_type: type[Config],
    task: Callable[[Config, Path | None], None],
    arguments: Sequence[str],
    more: Callable[[], str] | None,
) -> int:
    try:
        config, folder = _parse(name, config_type, arguments, more)
        _check_values(config)
        task(config, folder)
    except InputError as error:
        return _say(str(error), 2)
    except FitError as error:
        return _say(str(error), 1)
    except OSError as error:  # readers say InputError where they cannot read, so this is about writing
        return _say(_not_written(error), 2)
    except MemoryError as error:
        return _say(f"not enough memory ({error}); use less data or a smaller model", 2)
    except KeyboardInterrupt:
        return 130
    return 0


def _say(sentence: str, code: int) -> int:
    print(f"error: {one_line(sentence)}", file=sys.stderr)
    return code


def _not_written(error: OSError) -> str:
    file = error.filename2 or error.filename or "the run's files"
    if error.errno in FULL:
        return f"no space left to write {file}; make room and go on with --resume, or choose another --out"
    reason = "no permission" if isinstance(error, PermissionError) else error.strerror or str(error)
    return f"cannot write {file} ({reason}); choose another --out"


def _parse(
    name: str, config_type: type[Config], arguments: Sequence[str], more: Callable[[], str] | None
) -> tuple[Config, Path | None]:
    """The configuration, and the directory to resume where that is asked for."""
    match arguments:
        case ["--resume", resumed, *place] if not place or (place[0] == "--scheduler" and len(place) == 2):
            folder = Path(resumed)
            values = saved_config(folder, name.removeprefix("tasks."))
            values["scheduler"] = place[1] if place else None
        case ["--resume", *_]:
            raise InputError(
                "--resume takes one directory, and --scheduler to go on on a cluster; the rest is as the run began"
            )
        case _:
            description = "\n\n".join([inspect.cleandoc(config_type.__doc__ or ""), *([more()] if more else [])])
            return tyro.cli(config_type, prog=f"python -m {name}", description=description, args=arguments), None
    return configured(config_type, values, folder), folder


def configured(config_type: type[Config], values: Row, folder: Path) -> Config:
    """The configuration that a run has kept as plain values.

    Raises:
        InputError: those of another version.
    """
    try:
        return config_type(**{key: tuple(v) if isinstance(v, list) else v for key, v in values.items()})
    except TypeError as error:
        raise InputError(f"{folder} was begun by another version of this command ({error}); start a new run") from None


def _check_values(config: Any) -> None:
    """What no option may be: empty text, a number that is not finite, a seed that generators do not take.

    Raises:
        InputError: the first such option.
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


def choice(meaning: str, registry: Registry[Any]) -> Any:
    """Annotation of an option that takes names of a registry; its help lists what is registered when it is shown."""

    def entries(default: str) -> str:
        return f"{'; '.join(f'{name}: {registry.summary(name)}' for name in registry)} (default: {default})"

    return tyro.conf.arg(help=f"{meaning}:", help_behavior_hint=entries)


def choose_device(name: str) -> torch.device:
    """The device of that name; `auto` is the GPU where there is one.

    Raises:
        InputError: a GPU asked for where there is none, or fewer of them than processes.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda needs an NVIDIA GPU that torch can use, and there is none; use --device cpu")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda":
        check_gpus()
    return torch.device(name)


__all__ = ["SEEDS", "Preset", "Row", "Run", "choice", "choose_device", "command_line", "console"]
