"""From a command line to a checked configuration, and from errors to sentences and exit codes. Loads no torch."""

from __future__ import annotations

import errno
import inspect
import os
import sys
from argparse import ArgumentError, ArgumentParser
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import tyro
import yaml
from tyro.constructors import ConstructorRegistry, PrimitiveTypeInfo

from swiftwrf.errors import FitError, InputError, one_line
from swiftwrf.runtime.plain import TypedLoader, read_json
from tasks.options import Answered, Options
from tasks.terminal import terminal

Config = TypeVar("Config", bound=Options)
STYLE = (tyro.conf.OmitArgPrefixes, tyro.conf.PositionalMetavarFromFieldName, tyro.conf.DisallowNone)
MAX_CONFIG_BYTES = 2**20
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
BROKEN_PIPE = 141  # exit code that shells show for a process ended by SIGPIPE


def command_line(
    program: str, config_type: type[Config], task: Callable[[Config], None], arguments: Sequence[str]
) -> int:
    """Run a task with the options of a command line, and print an error as one sentence; see `execute`.

    Returns:
        0: done. 1: a fit failed. 2: wrong input, or a file that cannot be written. 130: interrupted. 141: the reader of the
        output, e.g. `head`, is gone.
    """
    try:
        execute(program, config_type, task, arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        return without_reader()
    except InputError as error:
        return _report(str(error), 2)
    except FitError as error:
        return _report(str(error), 1)
    except OSError as error:
        file = error.filename2 or error.filename or "the run's files"
        if error.errno in DISK_FULL:
            go_on = "free space and run the same command again, or resume what was stopped"
            return _report(f"no space left to write {file}; {go_on}", 2)
        reason = "no permission" if isinstance(error, PermissionError) else error.strerror or str(error)
        return _report(f"cannot read or write {file} ({reason}); choose another path", 2)
    except MemoryError as error:
        return _report(f"not enough memory ({error}); use less data or a smaller model", 2)
    except ImportError as error:
        return _report(f"a library cannot be loaded ({error}); install it again, or allow more memory", 2)
    except KeyboardInterrupt:
        return 130
    return 0


def without_reader() -> int:
    """Redirect the remaining output to nowhere, so that the flush at exit does not fail, and return the exit code."""
    with suppress(OSError, ValueError):  # a stream may have no file
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except BrokenPipeError:
                os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
    return BROKEN_PIPE


def _report(sentence: str, code: int) -> int:
    print(f"error: {one_line(sentence)}", file=sys.stderr)
    return code


def execute(program: str, config_type: type[Config], task: Callable[[Config], None], arguments: Sequence[str]) -> None:
    """Parse the command line of a program and run the task with its configuration; see `parse`.

    Raises:
        InputError: Wrong options, or the error of the task.
    """
    file = file_of_options(arguments)
    saved = None if file is None else file_options(Path(file))
    config = parse(config_type, arguments, program, saved, file)
    config.check()
    with terminal.of(getattr(config, "output", Answered()), config.verbose):
        task(config)


def file_of_options(arguments: Sequence[str]) -> str | None:
    """Return the value of --config on a command line, None without one.

    Raises:
        InputError: It is given twice or lacks its value.

    Example:
        >>> file_of_options(["--seed", "7", "--config=options.yaml"])
        'options.yaml'
    """
    parser = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--config", action="append", default=[])
    try:
        files = parser.parse_known_args(arguments)[0].config
    except ArgumentError as error:
        raise InputError(f"{error.argument_name}: {error.message}; --help shows its use") from None
    if len(files) > 1:
        raise InputError(f"--config is given twice: {' and '.join(files)}; give one")
    return files[0] if files else None


def parse(
    config_type: type[Config],
    arguments: Sequence[str],
    program: str,
    saved: Mapping[str, Any] | None = None,
    origin: object = "",
) -> Config:
    """Return the options of a command line.

    Args:
        config_type: Dataclass of the options. Its docstring is the description in the help.
        arguments: Options of the command line.
        program: Name of the command in the help.
        saved: Values of `file_options` or of a run by name, in place of the defaults.
        origin: File or directory of the saved values, for messages.

    Raises:
        InputError: A saved value that is not of its option's type, or an unknown name.
        SystemExit: Help, or options that do not exist or cannot be read.
    """
    left = dict(saved or {})
    defaults = _defaults(config_type, left, origin)
    for name in left:
        raise InputError(f"{origin} names {name!a}, which is no option of this command; --help lists them")
    # a flag that a file sets needs its negation on the command line
    style = STYLE if saved else (*STYLE, tyro.conf.FlagCreatePairsOff)
    description = inspect.cleandoc(config_type.__doc__ or "")
    found: Config = tyro.cli(
        config_type, prog=program, description=description, args=arguments, default=defaults, config=style
    )
    return found


def _defaults(kind: type[Any], saved: dict[str, Any], origin: object) -> Any:
    """Return options with the values that are taken from `saved`, and the others as they are by default.

    Raises:
        InputError: A value that its option does not take.
    """
    made, hints = object.__new__(kind), get_type_hints(kind, include_extras=True)  # required ones may be missing
    for option in fields(kind):
        default = tyro.MISSING if option.default is MISSING else option.default
        if is_dataclass(default):
            default = _defaults(type(default), saved, origin)
        elif (value := saved.pop(option.name, None)) is not None:
            default = _typed(option.name, value, hints[option.name], origin)
        object.__setattr__(made, option.name, default)
    return made


def _typed(name: str, value: Any, hint: Any, origin: object) -> Any:
    """Return a saved value in the type of its option, read like the words of a command line.

    Raises:
        InputError: The option does not take it.
    """
    items = value if isinstance(value, list) else [value]
    spec: Any = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(hint, set()))
    is_fitting = spec.nargs == "*" or len(items) in (spec.nargs if isinstance(spec.nargs, tuple) else (spec.nargs,))
    try:
        if not is_fitting or any(isinstance(item, dict | list) for item in items):
            raise ValueError
        return spec.instance_from_str([str(item) for item in items])
    except ValueError:
        raise InputError(f"{origin}: {name} takes {spec.metavar}, got {value!a}") from None


def file_options(file: Path) -> dict[str, Any]:
    """Return the options of a file by name. The config.json of a run holds them under `config`; its `out` is taken.

    Raises:
        InputError: No such file, or one that holds no names and values.
    """
    try:
        if not file.is_file() or file.stat().st_size > MAX_CONFIG_BYTES:
            raise OSError(f"expected a file of at most {MAX_CONFIG_BYTES} bytes")
        text = file.read_text(encoding="utf-8-sig")
        content = read_json(text) if file.suffix == ".json" else yaml.load(text, Loader=TypedLoader)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise InputError(f"--config {file} cannot be read ({error})") from None
    if isinstance(content, dict) and isinstance(content.get("config"), dict):
        content = content["config"] | {"out": None}
    if not isinstance(content, dict):
        raise InputError(f"--config {file} must hold options by name, got {type(content).__name__}")
    return {str(name): value for name, value in content.items()}
