"""Progress bars of long work, shown on a terminal only."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeVar

from rich import get_console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

Item = TypeVar("Item")


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:.1f} steps/s" if task.speed else "")


def progress_bar(shown: bool = True) -> Progress:
    """Return a bar with steps, rate and remaining time, which disappears at the end."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.0f}/{task.total:.0f}"))
    return Progress(
        *columns, _Rate(), TimeRemainingColumn(), transient=True, disable=not shown or not get_console().is_terminal
    )


def progress(items: Sequence[Item], description: str, shown: bool = True) -> Iterator[Item]:
    """Yield the items, with a progress bar.

    Example:
        >>> list(progress([1, 2], "counting"))
        [1, 2]
    """
    with progress_bar(shown) as bar:
        yield from bar.track(items, description=description)
