"""Output of a command: progress and results on stderr while it works, and the answer at the end on stdout."""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import Progress, ProgressColumn, Task
from rich.table import Table
from rich.text import Text

from swiftwrf.runtime.durable import strict
from swiftwrf.runtime.progress import forwarding
from tasks.options import General

if TYPE_CHECKING:  # which imports torch
    from swiftwrf.contrib.comparison.errors import ErrorSummary

LOGGERS = ("swiftwrf", "augment", "tasks")  # whose messages --verbose shows
PLAIN_WIDTH = 140  # characters of a table that is not shown on a terminal
MAX_USABLE, MAX_REFERENCES = 5, 2  # rows of the short table
SPEED_PERIOD_S = 120  # over which the speed is averaged for the time left
MAX_SILENCE_S = 20.0  # between two lines of a command that works and whose output is no terminal
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Method:
    """Errors of one method."""

    name: str  # name of the method in all results
    error: ErrorSummary  # summary of its errors
    is_reference: bool = False  # whether others are measured by it, rather than that a user would take it
    seconds: tuple[float, ...] = ()  # seconds to fit it, and to apply it to the test rows
    cells: Mapping[str, str] = field(default_factory=dict)  # further cells of its row in the report, by column


@dataclass(frozen=True)
class NextStep:
    """Sentence on what to do next, and a line of code to copy, if there is one."""

    text: str
    code: str = ""

    def __str__(self) -> str:
        return f"{self.text}: {self.code}" if self.code else self.text


@dataclass(frozen=True)
class Answer:
    """The answer of a run.

    Example:
        >>> error = {"median": 1.0, "low": 0.5, "high": 2.0, "mean": 1.5, "p90": 3.0, "n": 9}
        >>> answer = Answer("m", [Method("mean", error, is_reference=True), Method("knn", error)], "knn", [], [])
        >>> [[method.name for method in block] for block in answer.short()]
        [['knn'], ['mean']]
    """

    unit: str  # unit of the errors
    methods: Sequence[Method]  # errors of all methods, which are sorted by their medians
    chosen: str  # name of the method to take
    conclusion: Sequence[str]  # sentences: what the user asked, how sure it is, how it compares
    next_steps: Sequence[NextStep]  # what to do next
    shown: Sequence[str] = ()  # names of the methods that the short table has in any case

    def __post_init__(self) -> None:
        ordered = sorted(self.methods, key=lambda one: (not one.error["n"], one.error["median"]))
        object.__setattr__(self, "methods", ordered)

    def __str__(self) -> str:
        return "\n".join(self.conclusion)

    def short(self) -> tuple[list[Method], list[Method]]:
        """Return the methods that a user can take and the references of the short table, each sorted."""
        wanted = [self.chosen, *self.shown]
        first = sorted(self.methods, key=lambda one: wanted.index(one.name) if one.name in wanted else len(wanted))
        usable = [one for one in first if not one.is_reference][:MAX_USABLE]
        references = [one for one in first if one.is_reference][:MAX_REFERENCES]
        return [one for one in self.methods if one in usable], [one for one in self.methods if one in references]

    def values(self) -> dict[str, Any]:
        """Return the answer as plain values, for `--json`."""
        unit = self.unit.lower()
        return {
            "rows": [
                {
                    "method": one.name,
                    "chosen": one.name == self.chosen,
                    "reference": one.is_reference,
                    **{key if key == "n" else f"{key}_{unit}": value for key, value in one.error.items()},
                }
                for one in self.methods
            ],
            "conclusion": " ".join(self.conclusion),
            "next_steps": [vars(step) for step in self.next_steps],
        }


class _Line(ProgressColumn):
    """Number of the step and of all steps, what is computed, time left."""

    def render(self, task: Task) -> Text:
        left = task.time_remaining if task.description else None
        after = "" if left is None else f", {left:.0f} s left" if left < 100 else f", {left / 60:.0f} min left"
        return Text(f"{task.description}{after}", no_wrap=True, overflow="ellipsis")


class Terminal:
    """The terminal of a command.

    Attributes:
        console: Where notes and progress go. It is silent with `--quiet` and `--json`.
        options: General options of the command.

    Args:
        clock: Function of the time [s].
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.console = Console(stderr=True, highlight=False, soft_wrap=True)
        self.options = General()
        self._progress: Progress | None = None
        self._done = self._expected = 0
        self._steps: dict[str, tuple[str, int, float]] = {}  # those computed now: title, number, time of the beginning
        self._clock, self._doing = clock, ""
        self._began = self._printed = clock()  # the command, and its last line

    @contextmanager
    def of(self, options: General, endless: bool = False) -> Iterator[None]:
        """Show what the options ask for, during the context; with `verbose` also the messages of `logging`.

        A command whose output is no terminal prints a line at least every 20 s, unless it is endless.
        """
        self.options = options
        self._began, self._doing, ended = self._clock(), "working", threading.Event()
        self._printed = self._began
        self.console.quiet = options.quiet or options.json
        handler = RichHandler(console=self.console, show_path=False)
        loggers = [logging.getLogger(name) for name in LOGGERS] if options.verbose else []
        for each in loggers:
            each.addHandler(handler)
            each.setLevel(logging.DEBUG)
        if not endless:
            threading.Thread(target=self._remind_until, args=(ended,), daemon=True).start()
        try:
            yield
        finally:
            ended.set()
            self.options, self.console.quiet = General(), False
            for each in loggers:
                each.removeHandler(handler)
                each.setLevel(logging.NOTSET)

    @contextmanager
    def progress(self) -> Iterator[None]:
        """Show one line with the step that is computed and the time left; elsewhere than on a terminal, a line a step."""
        is_shown = self.console.is_terminal and not self.console.quiet
        line = Progress(
            _Line(), console=self.console, transient=True, disable=not is_shown, speed_estimate_period=SPEED_PERIOD_S
        )
        self._expected, self._done, self._steps = 0, 0, {}
        with line, forwarding(self._update):
            line.add_task("", total=None)
            self._progress = line
            try:
                yield
            finally:
                self._progress = None
                self._steps, self._doing = {}, "writing the results"

    def remind(self) -> None:
        """Print what is computed, and for how long, if the last line is 20 s old."""
        now = self._clock()
        if now - self._printed >= MAX_SILENCE_S:
            steps = [f"{self._numbered(name)}: {now - began:.0f} s" for name, (_, _, began) in [*self._steps.items()]]
            self._log("; ".join(steps) or f"{self._doing}: {now - self._began:.0f} s")

    def _remind_until(self, ended: threading.Event) -> None:
        while not ended.wait(MAX_SILENCE_S / 20):
            self.remind()

    def expect(self, steps: int) -> None:
        """Add steps to those that are to be done, or remove some."""
        self._expected += steps

    def begin(self, name: str, title: str) -> None:
        """Show that a step is computed now, by its unique name."""
        self._steps[name] = title, self._done + len(self._steps) + 1, self._clock()
        self._log(self._numbered(name))
        self._update()

    def end(self, name: str, result: str = "") -> None:
        """Count a step as done, and show its result."""
        seconds = self._clock() - self._steps[name][2]
        self._log(f"{self._numbered(name)}: {result + ', ' if result else ''}{seconds:.1f} s")
        del self._steps[name]
        self._done += 1
        self._update()

    def _numbered(self, name: str) -> str:
        title, number, _ = self._steps[name]
        return f"[{number}/{max(self._expected, number)}] {title}"

    def _log(self, line: str) -> None:
        """Print a line where no progress is shown; messages of `--verbose` contain it anyway."""
        self._printed = self._clock()
        logger.debug("%s", line)
        if not self.console.is_terminal and not logger.isEnabledFor(logging.DEBUG):
            self.console.print(line, markup=False, soft_wrap=True)

    def _update(self, fraction: float = 0.0) -> None:
        """Show the steps that are computed, with a fraction of the current one counted as done."""
        if self._progress is not None:
            title = ", ".join(self._numbered(name) for name in self._steps)
            done, total = self._done + fraction, max(self._expected, self._done)
            self._progress.update(self._progress.task_ids[0], description=title, completed=done, total=total)

    def answer(self, found: Answer, page: Path) -> None:
        """Print the answer of a run: the conclusion, a short table, next steps, and the place of the report."""
        self._print(found.values(), page, *found.conclusion, "", _table(found), "", *map(str, found.next_steps))

    def page(self, values: Mapping[str, Any], text: str, page: Path | None = None) -> None:
        """Print the text of a command, or its values with `--json`, and the place of its page. Both may be missing."""
        self._print(values, page, *filter(None, [text]))

    def _print(self, values: Mapping[str, Any], page: Path | None, *parts: str | Table) -> None:
        if self.options.json:
            report = {"report": str(page)} if page else {}
            print(json.dumps(strict({**values, **report}), allow_nan=False))
        else:
            width = None if sys.stdout.isatty() else PLAIN_WIDTH
            out = Console(file=sys.stdout, highlight=False, soft_wrap=True, width=width)
            for part in parts:
                out.print(part, markup=False)
            if page is not None:
                out.print(f"report: {page}", markup=False)
        if page is not None and self.options.open:
            webbrowser.open(page.resolve().as_uri())


def _table(found: Answer) -> Table:
    """Return the short table of an answer, in two blocks."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    unit = found.unit
    table.add_column("what you can use (* recommended)")
    for name in (f"median [{unit}]", "95 % interval", f"90 % below [{unit}]"):
        table.add_column(name, justify="right")
    for number, block in enumerate(found.short()):
        if number and block:
            table.add_row("references", style="bold")
        for one in block:
            error = one.error
            cells = (f"{error['median']:.2f}", f"{error['low']:.2f} to {error['high']:.2f}", f"{error['p90']:.2f}")
            table.add_row(f"{'*' if one.name == found.chosen else ' '} {one.name}", *cells)
    return table


terminal = Terminal()
console = terminal.console
