"""Output of a command: progress and results on stderr while it works, and the answer at the end on stdout."""

from __future__ import annotations

import json
import logging
import sys
import time
import webbrowser
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from swiftwrf.runtime.durable import strict
from swiftwrf.runtime.progress import forwarding
from tasks.options import Answered, Output

if TYPE_CHECKING:
    from swiftwrf.metrics import ErrorSummary

LOGGERS = ("swiftwrf", "augment", "tasks")  # whose messages --verbose shows
PLAIN_WIDTH = 140  # characters of a table that is not shown on a terminal
SPEED_PERIOD_S = 120  # over which the speed is averaged for the time left
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Answer:
    """The answer of a run: errors of everything that was compared, and what follows.

    Args:
        unit: Unit of the errors.
        rows: Names of what a row shows, e.g. condition and estimator, and the summary of its errors.
        conclusion: One sentence.
        next_steps: Sentences.
    """

    unit: str
    rows: Sequence[tuple[Mapping[str, str], ErrorSummary]]
    conclusion: str
    next_steps: Sequence[str]

    def values(self) -> dict[str, Any]:
        """Return the answer as plain values, for `--json`."""
        return {
            "rows": [
                {
                    **names,
                    **{key if key == "n" else f"{key}_{self.unit.lower()}": value for key, value in error.items()},
                }
                for names, error in self.rows
            ],
            "conclusion": self.conclusion,
            "next_steps": list(self.next_steps),
        }

    def table(self) -> Table:
        """Return the table of the terminal."""
        table = Table(box=None, pad_edge=False, header_style="bold")
        for name in self.rows[0][0]:
            table.add_column(name)
        for name in (f"median [{self.unit}]", "95 % interval", f"mean [{self.unit}]", f"90 % below [{self.unit}]"):
            table.add_column(name, justify="right")
        for names, error in self.rows:
            interval = f"{error['low']:.2f} to {error['high']:.2f}"
            cells = (f"{error['median']:.2f}", interval, f"{error['mean']:.2f}", f"{error['p90']:.2f}")
            table.add_row(*names.values(), *cells)
        return table


class Terminal:
    """The terminal of a command.

    Attributes:
        console: Where notes and progress go. It is silent with `--quiet` and `--json`.
    """

    def __init__(self) -> None:
        self.console = Console(stderr=True, highlight=False)
        self._output = Answered()
        self._progress: Progress | None = None
        self._done = self._expected = 0
        self._began = 0.0  # of the current step [s]

    @contextmanager
    def of(self, output: Answered, verbose: bool = False) -> Iterator[None]:
        """Show what the options ask for, during the context; with `verbose` also the messages of `logging`."""
        self._output = output
        self.console.quiet = self._output.quiet or self._output.json
        handler, loggers = RichHandler(console=self.console, show_path=False), [logging.getLogger(n) for n in LOGGERS]
        for logger in loggers if verbose else ():
            logger.addHandler(handler)
            logger.setLevel(logging.DEBUG)
        try:
            yield
        finally:
            self._output, self.console.quiet = Answered(), False
            for logger in loggers if verbose else ():
                logger.removeHandler(handler)
                logger.setLevel(logging.NOTSET)

    @contextmanager
    def progress(self) -> Iterator[None]:
        """Show the fraction of the steps that is done and the time left, on a terminal."""
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
        is_shown = self.console.is_terminal and not self.console.quiet
        bar = Progress(
            *columns, console=self.console, transient=True, disable=not is_shown, speed_estimate_period=SPEED_PERIOD_S
        )
        self._done = self._expected = 0
        with bar, forwarding(self._within):
            bar.add_task("", total=None)
            self._progress = bar
            try:
                yield
            finally:
                self._progress = None

    def expect(self, steps: int) -> None:
        """Add steps to those that are to be done."""
        self._expected += steps

    def begin(self, title: str) -> None:
        """Show what is computed now."""
        logger.debug("%s", title)
        self._began = time.perf_counter()
        self._update(description=title)

    def end(self) -> None:
        """Count a step as done."""
        logger.debug("done after %.1f s", time.perf_counter() - self._began)
        self._done += 1
        self._update(completed=self._done)

    def _within(self, fraction: float) -> None:
        """Count a fraction of the current step as done."""
        self._update(completed=self._done + fraction)

    def _update(self, **values: Any) -> None:
        if self._progress is not None:
            task = self._progress.task_ids[0]
            self._progress.update(task, total=max(self._expected, self._done), **values)

    def result(self, name: str, text: str) -> None:
        """Show a result as it comes."""
        self.console.print(f"{name:<44} {text}", markup=False, soft_wrap=True)

    def answer(self, found: Answer, page: Path) -> None:
        """Print the answer of a run and the place of its report."""
        self._print(
            found.values(), page, found.table(), "", found.conclusion, *(f"- {text}" for text in found.next_steps)
        )

    def page(self, values: Mapping[str, Any], text: str, page: Path | None = None) -> None:
        """Print the text of a command, or its values with `--json`, and the place of its page. Both may be missing."""
        self._print(values, page, *filter(None, [text]))

    def _print(self, values: Mapping[str, Any], page: Path | None, *parts: str | Table) -> None:
        if self._output.json:
            report = {"report": str(page)} if page else {}
            print(json.dumps(strict({**values, **report}), allow_nan=False, ensure_ascii=False))
        else:
            width = None if sys.stdout.isatty() else PLAIN_WIDTH
            out = Console(file=sys.stdout, highlight=False, soft_wrap=True, width=width)
            for part in parts:
                out.print(part, markup=False)
            if page is not None:
                out.print(f"report: {page}", markup=False)
        if page is not None and isinstance(self._output, Output) and self._output.open:
            webbrowser.open(page.resolve().as_uri())


terminal = Terminal()
console = terminal.console
