"""Progress bars of long work, shown on a terminal only. A command shows one bar and receives the fractions of the others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TextColumn, TimeRemainingColumn
from rich.text import Text

Item = TypeVar("Item")
_listener: Callable[[float], None] | None = None  # receives the fraction done in place of a bar


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(f"{task.speed:.1f} steps/s" if task.speed else "")


class _Forwarded(Progress):
    """A bar that is not shown and forwards its fraction."""

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        super().advance(task_id, advance)
        self._forward()

    def update(self, task_id: TaskID, **values: Any) -> None:
        super().update(task_id, **values)
        self._forward()

    def _forward(self) -> None:
        if _listener is not None and self.tasks:
            _listener(self.tasks[-1].percentage / 100)


@contextmanager
def forwarding(listener: Callable[[float], None]) -> Iterator[None]:
    """Forward the fractions of current work, in [0, 1], to a listener during the context, in place of showing bars."""
    global _listener
    outer, _listener = _listener, listener
    try:
        yield
    finally:
        _listener = outer


def silent() -> None:
    """Show no progress bar in this process from now on."""
    global _listener
    _listener = lambda fraction: None  # noqa: E731


def progress_bar(shown: bool = True) -> Progress:
    """Return a bar with steps, rate and remaining time, which disappears at the end."""
    if _listener is not None and shown:
        return _Forwarded(disable=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.0f}/{task.total:.0f}"))
    console = Console(stderr=True)
    return Progress(
        *columns,
        _Rate(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not shown or not console.is_terminal,
    )


def progress(items: Sequence[Item], description: str, shown: bool = True) -> Iterator[Item]:
    """Yield the items, with a progress bar.

    Example:
        >>> list(progress([1, 2], "counting"))
        [1, 2]
    """
    with progress_bar(shown) as bar:
        yield from bar.track(items, description=description)
