"""From a command line to a checked configuration, and from errors to sentences and exit codes. Loads no torch."""

from __future__ import annotations

import errno
import inspect
import os
import re
import sys
from argparse import ArgumentError, ArgumentParser, BooleanOptionalAction
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import tyro
import yaml

from swiftwrf.errors import FitError, InputError, one_line
from swiftwrf.runtime.plain import TypedLoader, read_json
from swiftwrf.runtime.validation import check_value
from tasks.options import (
    ALIASES,
    READING,
    FindingConfig,
    General,
    Options,
    ReadingConfig,
    ReadingOptions,
)
from tasks.terminal import terminal

Config = TypeVar("Config", bound=Options)
STYLE = (tyro.conf.OmitArgPrefixes, tyro.conf.PositionalMetavarFromFieldName, tyro.conf.DisallowNone)
HOW_TO_READ = "give --{} to swiftwrf inspect, which writes it beside the data, or in a file by --read FILE.yaml"
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
    general, own, saved = split(arguments)
    own = _with_data(config_type, own)
    finds = issubclass(config_type, FindingConfig) or not issubclass(config_type, ReadingConfig)
    declared = {option.name for option in fields(config_type)}  # aoa has a --station of its own
    for name in [] if finds else [name for name in _reading_options(own) if name not in declared]:
        raise InputError(f"--{name} is no option of this command; {HOW_TO_READ.format(name)}")
    config = parse(config_type, own, program, saved, general.config)
    config.check()
    if general.open and not config_type.opens:
        raise InputError("this command writes no report; leave out --open")
    try:
        with terminal.of(general, config.endless):
            task(config)
    except InputError as error:
        names = [] if finds else _reading_options(str(error).split())
        if not names or READING in str(error):
            raise
        raise InputError(f"{error}; {HOW_TO_READ.format(names[0])}") from error


def _with_data(config_type: type[Options], words: list[str]) -> list[str]:
    """Return the words of a command line with --data before a source that comes first, as in `swiftwrf rssi walk.csv`."""
    names = {option.name for option in fields(config_type)}
    takes_data = "data" in names and not names & {"source", "model"}  # which come first as they are
    return ["--data", *words] if takes_data and words and not words[0].startswith("-") else words


def _reading_options(words: Sequence[str]) -> list[str]:
    """Return the options of reading among the words of a command line or a sentence."""
    known = {option.name for option in fields(ReadingOptions)}
    names = [re.split("[^a-z-]", word.lstrip("(").removeprefix("--"))[0] for word in words if "--" in word[:3]]
    return [name for name in names if name.replace("-", "_") in known]


def split(arguments: Sequence[str]) -> tuple[General, list[str], dict[str, Any]]:
    """Return the general options of a command line, its other words, and the options by name in the file of --config.

    Raises:
        InputError: A general option that is given twice or lacks its value, or a file that cannot be read.

    Example:
        >>> split(["--seed", "7", "--json"])
        (General(config=None, verbose=False, quiet=False, json=True, open=False), ['--seed', '7'], {})
    """
    parser = ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--config", action="append", default=[])
    flags = [option.name for option in fields(General) if option.name != "config"]
    for name in flags:
        parser.add_argument(f"--{name}", action=BooleanOptionalAction)
    try:
        given, own = parser.parse_known_args(arguments)
    except ArgumentError as error:
        raise InputError(f"{error.argument_name}: {error.message}; --help shows its use") from None
    if len(given.config) > 1:
        raise InputError(f"--config is given twice: {' and '.join(given.config)}; give one")
    file = given.config[0] if given.config else None
    saved = {} if file is None else file_options(Path(file))
    values = {name: saved.pop(name, False) for name in flags}
    values |= {name: value for name in flags if (value := getattr(given, name)) is not None}
    for name, value in values.items():
        check_value(f"{file}: {name}", value, bool)
    return General(file, **values), own, saved


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
        arguments: Options of the command line, without general ones.
        program: Name of the command in the help.
        saved: Values of `file_options` or of a run by name, in place of the defaults.
        origin: File or directory of the saved values, for messages.

    Raises:
        InputError: A saved value that its option does not take, or an unknown name.
        SystemExit: Help, or options that do not exist or cannot be read.
    """
    left = {ALIASES.get(name, name): value for name, value in (saved or {}).items()}
    defaults = from_names(config_type, left, origin)
    for name in left:
        raise InputError(f"{origin} names {name!a}, which is no option of this command; --help lists them")
    # a flag that a file sets needs its negation on the command line
    style = STYLE if saved else (*STYLE, tyro.conf.FlagCreatePairsOff)
    general = ", ".join(f"--{option.name}" for option in fields(General))
    description = f"{inspect.cleandoc(config_type.__doc__ or '')}\n\nGeneral options, see swiftwrf --help: {general}"
    found: Config = tyro.cli(
        config_type, prog=program, description=description, args=arguments, default=defaults, config=style
    )
    return found


def from_names(kind: type[Any], saved: dict[str, Any], origin: object) -> Any:
    """Return options with the values that are taken from `saved`, and the others as they are by default.

    Required options that are missing are `tyro.MISSING`, which the command line replaces.

    Raises:
        InputError: A value that its option does not take.

    Example:
        >>> from_names(General, {"json": True}, "options.yaml").json
        True
    """
    values, hints = {}, get_type_hints(kind, include_extras=True)
    for option in fields(kind):
        if is_dataclass(option.default):
            values[option.name] = from_names(type(option.default), saved, origin)
        elif (value := saved.pop(option.name, None)) is not None:
            values[option.name] = _typed(f"{origin}: {option.name}", value, hints[option.name])
        elif option.default is MISSING:
            values[option.name] = tyro.MISSING
    return kind(**values)


def _typed(name: str, value: Any, hint: Any) -> Any:
    """Return a value of a file as its option has it: lists are tuples, one value is a list of it, and numbers are texts.

    Raises:
        InputError: The option does not take it.
    """
    items = tuple(value) if isinstance(value, list) else (value,)
    texts = tuple(str(item) if type(item) in (int, float) else item for item in items)
    for form in (items, texts) if isinstance(value, list) else (value, *texts, items, texts):
        with suppress(InputError):
            check_value(name, form, hint)
            return form
    check_value(name, value, hint)
    return value


def file_options(file: Path, option: str = "config") -> dict[str, Any]:
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
        raise InputError(f"--{option} {file} cannot be read ({error})") from None
    if isinstance(content, dict) and isinstance(content.get("config"), dict):
        content = content["config"] | {"out": None}
    if not isinstance(content, dict):
        raise InputError(f"--{option} {file} must hold options by name, got {type(content).__name__}")
    return {str(name): value for name, value in content.items()}


def reading_options(file: Path) -> ReadingOptions:
    """Return the options of reading in a file.

    Raises:
        InputError: No such file, or one that holds anything else.
    """
    saved = file_options(file, "read")
    found: ReadingOptions = from_names(ReadingOptions, saved, file)
    for name in saved:
        raise InputError(f"{file} names {name!a}, which is no option of reading; swiftwrf inspect --help lists them")
    found.check()
    return found
