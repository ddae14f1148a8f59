"""From a command line to a checked configuration, and from errors to sentences and exit codes. Loads no torch."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

from swiftwrf.errors import FitError, InputError, one_line
from tasks.options import Answered, Options
from tasks.parsing import file_of_options, file_options, parse
from tasks.terminal import terminal

Config = TypeVar("Config", bound=Options)
DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
BROKEN_PIPE = 141  # exit code that shells show for a process ended by SIGPIPE


def command_line(
    name: str,
    config_type: type[Config],
    task: Callable[[Config], None],
    arguments: Sequence[str],
    program: str | None = None,
) -> int:
    """Run a task with the options of a command line; see `execute` and `exit_code`."""
    return exit_code(partial(execute, name, config_type, task, arguments, program))


def exit_code(action: Callable[[], None]) -> int:
    """Return the exit code of an action and print its error as one sentence.

    Returns:
        0: done. 1: a fit failed. 2: wrong input, or a file that cannot be written. 130: interrupted. 141: the reader of the
        output, e.g. `head`, is gone.
    """
    try:
        action()
        sys.stdout.flush()
    except BrokenPipeError:
        return without_reader()
    except InputError as error:
        return _report(str(error), 2)
    except FitError as error:
        return _report(str(error), 1)
    except OSError as error:
        return _report(_no_access(error), 2)
    except MemoryError as error:
        return _report(f"not enough memory ({error}); use less data or a smaller model", 2)
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


def _no_access(error: OSError) -> str:
    file = error.filename2 or error.filename or "the run's files"
    if error.errno in DISK_FULL:
        return f"no space left to write {file}; free space and run the same command again, or resume what was stopped"
    reason = "no permission" if isinstance(error, PermissionError) else error.strerror or str(error)
    return f"cannot read or write {file} ({reason}); choose another path"


def execute(
    name: str,
    config_type: type[Config],
    task: Callable[[Config], None],
    arguments: Sequence[str],
    program: str | None = None,
) -> None:
    """Parse a command line and run the task.

    Args:
        name: Module of the task, e.g. tasks.aoa.
        config_type: Dataclass of the options. Its docstring is the description in the help.
        task: Function of the configuration.
        arguments: Options of the command line.
        program: Name of the command in the help. Defaults to `python -m NAME`.

    Raises:
        InputError: Wrong options, or the error of the task.
    """
    file = file_of_options(arguments)
    saved = None if file is None else file_options(Path(file))
    config = parse(config_type, arguments, program or f"python -m {name}", saved, file)
    config.check()
    with terminal.of(getattr(config, "output", Answered()), config.verbose):
        task(config)
