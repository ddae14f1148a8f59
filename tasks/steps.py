"""What a run computes, cut into steps: each is kept when it is done, says what follows from it, and may run anywhere."""

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
from tasks.directory import Run, console
from tasks.records import Row, strict

if TYPE_CHECKING:
    from distributed import Future

Setting = TypeVar("Setting")  # what all steps of a run share


class Step(ABC, Generic[Setting]):
    """One computation of a run. It may travel, so it is small: what is large is in the setting and in files."""

    @property
    @abstractmethod
    def name(self) -> str:
        """What it is kept under; steps of one name are the same step."""

    @property
    def reads(self) -> tuple[str, ...]:
        """Files in the run's directory that it needs, left there by the step from which it follows."""
        return ()

    @abstractmethod
    def compute(self, setting: Setting, folder: Path) -> Row:
        """Plain values. Files are read and left in the folder: the run's directory, or one that stands for it."""

    def then(self, setting: Setting, value: Row) -> Sequence[Step[Setting]]:
        """The steps that follow from what it computed."""
        return ()


def computed(
    run: Run, steps: Iterable[Step[Setting]], setting: Setting, cluster: Cluster | None
) -> Iterator[tuple[Step[Setting], Row]]:
    """Each step with what it computed, and after it those that follow from it: in this order wherever they are computed.

    Args:
        run: where they are kept; what is kept is not computed again.
        steps: the first ones.
        setting: what all share.
        cluster: computes as many as it has workers at a time; None: here, one after the other.

    Raises:
        FitError: the cluster was lost.
    """
    if cluster is not None:
        steps = list(steps)
        _compute_on(cluster, run, steps, setting)
    for step in steps:
        value = run.step(step.name, partial(step.compute, setting, run.folder))
        yield step, value
        yield from computed(run, step.then(setting, value), setting, None)


def _compute_on(cluster: Cluster, run: Run, steps: Iterable[Step[Setting]], setting: Setting) -> None:
    """Keeps in the run what the steps, and those that follow, compute on a cluster, as they get done."""
    function = cluster.hold(partial(_compute_away, setting))
    pending: dict[Future[Any], Step[Setting]] = {}
    begun: set[str] = set()

    def begin(steps: Iterable[Step[Setting]]) -> None:
        held: dict[str, Future[Any]] = {}
        for step in steps:
            value = run.kept(step.name)
            if value is not None:
                begin(step.then(setting, value))
            elif step.name not in begun:
                begun.add(step.name)
                held |= {name: cluster.hold(run.path(name).read_bytes()) for name in step.reads if name not in held}
                urgent = type(step).then is not Step.then  # others wait for it
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
        console.print(f"[bold]{step.name}[/] {seconds:.1f} s")
        begin(step.then(setting, value))


def _compute_away(setting: Setting, step: Step[Setting], *contents: bytes) -> tuple[Row, float, dict[str, bytes]]:
    """On a worker, which has no directory of the run: values, seconds, and the content of the files
    that were left."""
    with TemporaryDirectory(prefix="swiftwrf-") as name:
        folder = Path(name)
        (folder / STEPS).mkdir()
        for file, content in zip(step.reads, contents, strict=True):
            (folder / file).write_bytes(content)
        began = time.perf_counter()
        value: Row = strict(step.compute(setting, folder))
        seconds = time.perf_counter() - began
        left = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
        return value, seconds, {file: path.read_bytes() for file, path in left.items() if file not in step.reads}
