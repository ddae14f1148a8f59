"""The computation of a run, cut into steps. The result of each is kept, and a step may run on any machine."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from swiftwrf.runtime.durable import write_bytes
from tasks.claim import STEPS
from tasks.cluster import Cluster
from tasks.directory import Run
from tasks.processes import local_processes
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
        """Description of the step for the terminal."""
        return self.name

    @property
    def reads(self) -> tuple[str, ...]:
        """Files in the run's directory that the step reads, written by the step from which it follows."""
        return ()

    @abstractmethod
    def compute(self, context: Context, folder: Path) -> Row:
        """Return plain values. Files are read and written in `folder`: the run's directory, or a copy on a worker."""

    @property
    def priority(self) -> int:
        """Priority among the steps that could begin: 2 if other steps wait for this one, 1 if it takes long, else 0."""
        return 2 if type(self).then is not Step.then else 0

    @property
    def is_optional(self) -> bool:
        """True for a step that a budget may leave out."""
        return False

    def then(self, context: Context, value: Row) -> Sequence[Step[Context]]:
        """Return the steps that follow from the result."""
        return ()


class Budget:
    """Time of a run within which optional steps must end. Without a limit all steps are computed.

    Args:
        seconds: Time from now [s]. Defaults to no limit.
    """

    def __init__(self, seconds: float | None = None) -> None:
        self._seconds = math.inf if seconds is None else seconds
        self._began, self._longest = time.monotonic(), 0.0

    def refusal(self, step: Step[Any]) -> Row | None:
        """Return the result of a step that is left out, or None if it is computed.

        An optional step is expected to take as long as the longest one so far.
        """
        if not step.is_optional or time.monotonic() - self._began + self._longest < self._seconds:
            return None
        return {"refused": f"its training does not fit into the budget of {self._seconds:g} s"}

    def spent(self, step: Step[Any], seconds: float) -> None:
        """Record the time of a step."""
        if step.is_optional:
            self._longest = max(self._longest, seconds)

    def priority(self, step: Step[Any]) -> int:
        """Return the priority of a step. With a limit optional steps come last."""
        return -1 if step.is_optional and math.isfinite(self._seconds) else step.priority


Arrived = Callable[[Step[Context], Row], None]
"""function that shows a result when it arrives"""


class Workers(Protocol):
    """Processes that compute steps, on this machine or on a cluster. The type of a future depends on the implementation."""

    slots: float
    """number of steps that are computed at a time; infinite if the workers keep a queue"""

    def submit(self, step: Step[Any]) -> Any:
        """Begin a step and return its future."""

    def next(self, pending: Collection[Any]) -> tuple[Any, Row, float]:
        """Wait for one of the futures and return it with the values of its step and the seconds."""


def computed(
    run: Run,
    steps: Iterable[Step[Context]],
    context: Context,
    cluster: Cluster | None,
    arrived: Arrived[Context] = lambda step, value: None,
    budget: Budget | None = None,
) -> Iterator[tuple[Step[Context], Row]]:
    """Yield each step with its result, followed by the steps that follow from it.

    Args:
        run: Run that keeps the results, and has the number of processes. A kept result is not computed again.
        steps: The first steps.
        context: Data and configuration that all steps share.
        cluster: Cluster that computes the steps in parallel.
        arrived: Called with each step and its result as soon as it arrives, in any order.
        budget: Time within which optional steps must end. Steps that are left out are yielded with the reason as their
            result, which is not kept.

    Raises:
        FitError: The cluster or a process is lost.
    """
    steps, budget = list(steps), budget or Budget()
    if cluster is not None:
        _compute_on(_ClusterWorkers(cluster, run, context), run, steps, context, arrived, budget)
    elif run.processes > 1:
        with local_processes(run.processes, run.folder, context) as local:
            _compute_on(local, run, steps, context, arrived, budget)
    yield from _computed_here(run, steps, context, None if cluster or run.processes > 1 else arrived, budget)


def _computed_here(
    run: Run, steps: Sequence[Step[Context]], context: Context, arrived: Arrived[Context] | None, budget: Budget
) -> Iterator[tuple[Step[Context], Row]]:
    """Yield each step with its result, computed in this process unless it is kept, and the steps that follow."""
    terminal.expect(len({step.name for step in steps if not run.holds(step.name)}))
    for step in sorted(steps, key=lambda step: budget.priority(step) < 0):
        is_new = not run.holds(step.name)
        if is_new and (refusal := budget.refusal(step)):
            yield step, refusal
            continue
        began = time.perf_counter()
        value = run.step(step.name, step.title, partial(step.compute, context, run.folder))
        if is_new:
            budget.spent(step, time.perf_counter() - began)
        if arrived is not None and is_new:
            arrived(step, value)
        yield step, value
        yield from _computed_here(run, step.then(context, value), context, arrived, budget)


def _compute_on(
    workers: Workers,
    run: Run,
    steps: Iterable[Step[Context]],
    context: Context,
    arrived: Arrived[Context],
    budget: Budget,
) -> None:
    """Compute steps, and those that follow, on workers and keep each result in the run when it arrives.

    A step that was begun already under its name is not begun again, but the steps that follow from it are.
    """
    waiting: list[Step[Context]] = []
    pending: dict[Any, Step[Context]] = {}
    same: dict[str, list[Step[Context]]] = {}

    def begin(steps: Iterable[Step[Context]]) -> None:
        for step in steps:
            value = run.kept(step.name)
            if value is not None:
                begin(step.then(context, value))
            elif step.name in same:
                same[step.name].append(step)
            else:
                same[step.name] = [step]
                terminal.expect(1)
                waiting.append(step)

    begin(steps)
    while pending or waiting:
        waiting.sort(key=lambda step: -budget.priority(step))
        while waiting and len(pending) < workers.slots:
            step = waiting.pop(0)
            if not budget.refusal(step):
                pending[workers.submit(step)] = step
        if not pending:
            break
        terminal.begin(", ".join(dict.fromkeys(step.title for step in pending.values())))
        future, value, seconds = workers.next(pending)
        step = pending.pop(future)
        value = run.keep(step.name, value, seconds)
        budget.spent(step, seconds)
        terminal.end()
        arrived(step, value)
        for one in same.pop(step.name):
            begin(one.then(context, value))


class _ClusterWorkers(Generic[Context]):
    """The workers of a cluster, which compute steps in copies of a run's directory.

    Args:
        cluster: Cluster.
        run: Run whose files the steps read and write.
        context: Data and configuration that all steps share.
    """

    slots = math.inf

    def __init__(self, cluster: Cluster, run: Run, context: Context) -> None:
        self._cluster, self._run = cluster, run
        self._function = cluster.hold(partial(_compute_away, context))
        self._held: dict[str, Future[Any]] = {}

    def submit(self, step: Step[Context]) -> Future[Any]:
        """Begin a step on a worker, with the files that it reads."""
        known = self._held  # steps that follow from one step read the same files and come one after the other
        self._held = {
            name: known[name] if name in known else self._cluster.hold(self._run.path(name).read_bytes())
            for name in step.reads
        }
        return self._cluster.submit(step.name, self._function, step, *self._held.values(), priority=step.priority)

    def next(self, pending: Collection[Future[Any]]) -> tuple[Future[Any], Row, float]:
        """Wait for one of the steps, write its files, and return it with its values and its seconds."""
        future, (value, seconds, files) = self._cluster.next(pending)
        for name, content in files.items():
            write_bytes(self._run.path(name), content)
        self._run.computed_on(self._cluster.machines)
        return future, value, seconds


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
