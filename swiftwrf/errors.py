"""Exceptions of this package."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from typing import Any

MAX_LENGTH = 300  # characters of a message: what came may be a megabyte long
MAX_NAMES = 12  # names in a message
CONTENT_ERRORS = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""exceptions that inconsistent content of a file or line raises where it is used"""


def one_line(message: str) -> str:
    """Return the message without line breaks. A long message loses its middle, because both ends are needed.

    The beginning states the fault, the end the remedy.
    """
    line = " ".join(message.split())
    if len(line) <= MAX_LENGTH:
        return line
    kept = MAX_LENGTH - len(" ... ")
    return f"{line[: kept // 2]} ... {line[-(kept - kept // 2) :]}"


def listed(names: Iterable[object]) -> str:
    """Return the first names and the number of further ones."""
    texts = [str(name) for name in names]
    return ", ".join(texts[:MAX_NAMES]) + (f" and {len(texts) - MAX_NAMES} more" if texts[MAX_NAMES:] else "")


def ranges(numbers: Iterable[int]) -> str:
    """Return ascending numbers in words, neighbours joined.

    Example:
        >>> ranges([1, 4, 5, 6, 9])
        '1, 4 to 6, 9'
    """
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 1 else str(run[0]) for run in runs)


class InputError(ValueError):
    """Wrong input. The message is one sentence: what was expected, what came and what to do.

    Commands print the sentence and exit with code 2.

    Example:
        >>> import swiftwrf
        >>> swiftwrf.simulated_room(n=0)
        Traceback (most recent call last):
        swiftwrf.errors.InputError: ...
    """

    def __init__(self, message: object) -> None:
        super().__init__(one_line(str(message)))


class NotFitted(InputError, AttributeError):
    """An attribute that `fit` sets is asked of a model that is not fitted.

    Example:
        >>> import swiftwrf
        >>> swiftwrf.make_model("geometry").planes
        Traceback (most recent call last):
        swiftwrf.errors.NotFitted: this GeometryModel is not fitted; call fit first
    """


class FitError(RuntimeError):
    """A fit that cannot go on. The last good state remains on disk if a checkpoint path was given.

    Example:
        >>> str(FitError("the loss is not finite"))
        'the loss is not finite'
    """

    def __init__(self, message: object) -> None:
        super().__init__(one_line(str(message)))


def optional_module(name: str, purpose: str, extra: str) -> Any:
    """Return a module that an extra of this package installs.

    Raises:
        InputError: It is not installed; the message begins with the purpose.

    Example:
        >>> optional_module("nowhere", "maps of nowhere need nowhere", "maps")
        Traceback (most recent call last):
        swiftwrf.errors.InputError: maps of nowhere need nowhere; install it with pip install 'swiftwrf-tasks[maps]'
    """
    try:
        return import_module(name)
    except ImportError:
        raise InputError(f"{purpose}; install it with pip install 'swiftwrf-tasks[{extra}]'") from None


def with_article(noun: str) -> str:
    """Return a noun with its indefinite article.

    Example:
        >>> with_article("hybrid model"), with_article("inverse-distance model"), with_article("RSSI locator")
        ('a hybrid model', 'an inverse-distance model', 'an RSSI locator')
    """
    spoken_as_vowel = noun.lower().startswith(("a", "e", "i", "o", "rssi"))
    return f"{'an' if spoken_as_vowel else 'a'} {noun}"
