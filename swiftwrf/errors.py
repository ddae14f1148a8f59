"""The two ways this package says no."""

from __future__ import annotations

from collections.abc import Iterable

LONGEST = 300  # characters of a message: what came may be a megabyte long
MOST = 12  # names in a message


def one_line(message: str) -> str:
    """The message without line breaks, its middle left out where it is too long: what is wrong stands at the beginning,
    what to do at the end."""
    line = " ".join(message.split())
    if len(line) <= LONGEST:
        return line
    kept = LONGEST - len(" ... ")
    return f"{line[: kept // 2]} ... {line[-(kept - kept // 2) :]}"


def listed(names: Iterable[object]) -> str:
    """The first names, and how many more there are."""
    found = [str(name) for name in names]
    return ", ".join(found[:MOST]) + (f" and {len(found) - MOST} more" if found[MOST:] else "")


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
    """Wrong input: one sentence saying what was expected, what came and what to do.

    Commands print the sentence and exit with code 2.
    """

    def __init__(self, message: object) -> None:
        super().__init__(one_line(str(message)))


class FitError(RuntimeError):
    """A fit that cannot go on; the last good state is kept on disk where a checkpoint path was given."""

    def __init__(self, message: object) -> None:
        super().__init__(one_line(str(message)))
