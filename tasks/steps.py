"""The computation of a run, cut into steps. The result of each is kept, and a step may run in any process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any

from swiftwrf import InputError
from swiftwrf.runtime.steps import Context, Step, walk
from tasks.directory import Run
from tasks.records import ENVIRONMENT, Row
from tasks.terminal import terminal
from tasks.workers import Workers, local_processes

Described = Callable[[Step[Context], Row], str]
"""function that returns the result of a step in words, empty if there is nothing to show"""


def run_steps(
    run: Run,
    steps: Iterable[Step[Context]],
    context: Context,
    cluster: Workers | None = None,
    described: Described[Context] = lambda step, value: "",
) -> Iterator[tuple[Step[Context], Row]]:
    """Yield each step with its result, followed by the steps that follow from it.

    Args:
        run: Run that keeps the results, and has the number of processes. A kept result is not computed again.
        steps: The first steps.
        context: Data and configuration that all steps share.
        cluster: Workers that compute the steps. Defaults to the processes of the run.
        described: Result of a step in words, which the terminal shows when it arrives.

    Raises:
        FitError: The cluster or a process is lost.
    """
    steps = list(steps)
    if cluster is not None:
        try:
            _compute_on(cluster, run, steps, context, described)
        finally:
            run.computed_on(cluster.machines)
    elif run.processes > 1:
        with local_processes(run.processes, run.folder) as processes:
            _compute_on(processes, run, steps, context, described)

    def expect(some: Iterable[Step[Context]]) -> None:
        terminal.expect(len({step.name for step in some if not run.holds(step.name)}))

    def compute(step: Step[Context]) -> Row:
        value = run.step(step.name, step.title, partial(step.compute, context, run.folder), partial(described, step))
        expect(step.then(context, value))
        return value

    expect(steps)
    yield from walk(steps, context, compute)


def _compute_on(
    workers: Workers, run: Run, steps: Iterable[Step[Context]], context: Context, described: Described[Context]
) -> None:
    """Compute steps, and those that follow, on workers and keep each result in the run when it arrives.

    A step that was begun already under its name is not begun again, but the steps that follow from it are.
    """
    compute = workers.hold(partial(_compute_away, context, run.folder.resolve()))
    waiting: list[Step[Context]] = []
    pending: dict[Future[Any], Step[Context]] = {}
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
        waiting.sort(key=lambda step: -step.priority)
        while waiting and len(pending) < workers.slots():
            step = waiting.pop(0)
            pending[workers.submit(compute, step)] = step
            terminal.begin(step.name, step.title)
        future, (value, seconds) = workers.next(pending)
        step = pending.pop(future)
        value = run.keep(step.name, value, seconds)
        terminal.end(step.name, described(step, value))
        for one in same.pop(step.name):
            begin(one.then(context, value))


def _compute_away(context: Context, folder: Path, step: Step[Context]) -> tuple[Row, float]:
    """Return values and seconds of a step, computed in a worker."""
    if not (folder / ENVIRONMENT).exists():
        raise InputError(f"a worker does not see {folder}; choose an --out on a file system that all machines share")
    began = time.perf_counter()
    return step.compute(context, folder), time.perf_counter() - began
