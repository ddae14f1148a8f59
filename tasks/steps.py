"""The computation of a run, cut into steps. The result of each is kept, and a step may run on any machine."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from swiftwrf.runtime.durable import write_bytes
from tasks.claim import STEPS
from tasks.cluster import Cluster
from tasks.directory import Run
from tasks.records import Row, strict
from tasks.terminal import terminal

if TYPE_CHECKING:
    from distributed import Future

Context = TypeVar("Context")
"""data and configuration that all steps of a run share"""


class Step(ABC, Generic[Context]):
    """One computation of a run. It is sent to workers, so it is small: large data are in the context and in files."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Key of the kept result. Steps with one name are one step."""

    @property
    def title(self) -> str:
        """What is computed, for the terminal."""
        return self.name

    @property
    def reads(self) -> tuple[str, ...]:
        """Files in the run's directory that the step reads, written by the step from which it follows."""
        return ()

    @abstractmethod
    def compute(self, context: Context, folder: Path) -> Row:
        """Return plain values. Files are read and written in `folder`: the run's directory, or a copy on a worker."""

    def then(self, context: Context, value: Row) -> Sequence[Step[Context]]:
        """Return the steps that follow from the result."""
        return ()


def computed(
    run: Run, steps: Iterable[Step[Context]], context: Context, cluster: Cluster | None
) -> Iterator[tuple[Step[Context], Row]]:
    """Yield each step with its result, followed by the steps that follow from it.

    Args:
        run: Run that keeps the results. A kept result is not computed again.
        steps: The first steps.
        context: Data and configuration that all steps share.
        cluster: Cluster that computes the steps in parallel. With None they are computed here, one after the other.

    Raises:
        FitError: The cluster is lost.
    """
    steps = list(steps)
    if cluster is not None:
        _compute_on(cluster, run, steps, context)
    terminal.expect(len({step.name for step in steps if not run.holds(step.name)}))
    for step in steps:
        value = run.step(step.name, step.title, partial(step.compute, context, run.folder))
        yield step, value
        yield from computed(run, step.then(context, value), context, None)


def _compute_on(cluster: Cluster, run: Run, steps: Iterable[Step[Context]], context: Context) -> None:
    """Compute steps, and those that follow, on a cluster and keep each result in the run when it arrives."""
    function = cluster.hold(partial(_compute_away, context))
    pending: dict[Future[Any], Step[Context]] = {}
    begun: set[str] = set()

    def begin(steps: Iterable[Step[Context]]) -> None:
        held: dict[str, Future[Any]] = {}
        for step in steps:
            value = run.kept(step.name)
            if value is not None:
                begin(step.then(context, value))
            elif step.name not in begun:
                begun.add(step.name)
                terminal.expect(1)
                held |= {name: cluster.hold(run.path(name).read_bytes()) for name in step.reads if name not in held}
                urgent = type(step).then is not Step.then  # other steps wait for it
                future = cluster.submit(step.name, function, step, *(held[name] for name in step.reads), urgent=urgent)
                pending[future] = step

    begin(steps)
    while pending:
        future, (value, seconds, files) = cluster.next(pending)
        step = pending.pop(future)
        for name, content in files.items():
            write_bytes(run.path(name), content)
        value = run.keep(step.name, value, seconds)
        run.computed_on(cluster.machines)
        terminal.end()
        begin(step.then(context, value))


def _compute_away(context: Context, step: Step[Context], *contents: bytes) -> tuple[Row, float, dict[str, bytes]]:
    """Compute a step on a worker, in a copy of the run's directory. Return values, seconds and the content of new files."""
    with TemporaryDirectory(prefix="swiftwrf-") as name:
        folder = Path(name)
        (folder / STEPS).mkdir()
        for file, content in zip(step.reads, contents, strict=True):
            (folder / file).write_bytes(content)
        began = time.perf_counter()
        value: Row = strict(step.compute(context, folder))
        seconds = time.perf_counter() - began
        left = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
        return value, seconds, {file: path.read_bytes() for file, path in left.items() if file not in step.reads}
