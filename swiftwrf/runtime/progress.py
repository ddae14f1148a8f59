"""The progress of long work, on a terminal; nothing elsewhere."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeVar

from rich import get_console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:.1f} steps/s" if task.speed else "")


def progress_bar(shown: bool = True) -> Progress:
    """A bar with steps, rate and time left; it disappears when it is done."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.0f}/{task.total:.0f}"))
    return Progress(
        *columns, _Rate(), TimeRemainingColumn(), transient=True, disable=not shown or not get_console().is_terminal
    )


Item = TypeVar("Item")


def progress(items: Sequence[Item], description: str, shown: bool = True) -> Iterator[Item]:
    """The items, with a bar."""
    with progress_bar(shown) as bar:
        yield from bar.track(items, description=description)
