"""Named steps of an experiment: their results are kept for a call that continues it, and they may run side by side."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import contextmanager, suppress
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from pickle import PicklingError
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any, Generic, TypeVar
from weakref import finalize

from swiftwrf.errors import InputError
from swiftwrf.runtime.durable import strict, write_json

STEPS = "steps"  # folder, beside the results, of kept values and of files that only later steps read
MODEL, LOCATOR = "model.safetensors", "locator.safetensors"  # fitted models of RSSI, among the results
ORIGIN = "origin"  # what the kept results are of
NOT_OF_RESULTS = ("keep", "executor", "parallel", "progress")  # arguments on which no result depends
POLL_S = 2  # between two checks that there are workers

Row = dict[str, Any]
Context = TypeVar("Context")
"""data and configuration that all steps share"""


@contextmanager
def refusing_executor(executor: Executor | None) -> Iterator[None]:
    """Raise InputError for a user's executor that is shut down, loses its processes or cannot be sent what they compute."""
    try:
        yield
    except (AttributeError, PicklingError, RuntimeError, TypeError) as error:
        is_of_user = executor is not None and not hasattr(executor, "slots")  # workers of a command have own sentences
        if not is_of_user or not (isinstance(error, BrokenExecutor) or re.search("pickle|shutdown", str(error))):
            raise
        remedy = "give an open one, models and estimators of classes that a module defines, or leave it out"
        raise InputError(f"the executor does not compute the steps ({error}); {remedy}") from None


@cache  # looked up at every step of a run
def packages() -> dict[str, str]:
    """Return the versions of this project and of the libraries on which results depend."""
    found = {}
    for name in ("swiftwrf-tasks", "torch", "torchvision", "numpy", "scipy", "scikit-learn", "numba"):
        with suppress(PackageNotFoundError):  # numba is an extra
            found[name] = version(name)
    return found


def check_unchanged(folder: Path, before: Any, now: Mapping[str, str]) -> None:
    """Refuse to continue what began with other input, by the digests and versions of all that decides the results.

    Raises:
        InputError: They differ; the message names those that do, and earlier versions.
    """
    if before != now:
        before = before if isinstance(before, dict) else {}
        changed = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
        was = (f"{name} {known}" if len(known := str(before.get(name, ""))) < 64 else name for name in changed)
        raise InputError(
            f"the input or a version has changed since {folder} began ({', '.join(map(str.strip, was))}); restore it or "
            "begin in a new folder"
        )


class Memo:
    """Results of steps by name, kept in a folder. Steps write their files there, too.

    Args:
        folder: Folder of the results. Defaults to a temporary one, which is deleted with this object.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     Memo(Path(folder)).keep("sum", {"value": 3}, seconds=0.1)
        ...     Memo(Path(folder)).kept("sum")
        {'value': 3}
        {'value': 3}
    """

    def __init__(self, folder: Path | None = None) -> None:
        if folder is None:
            folder = Path(mkdtemp(prefix="swiftwrf-"))
            finalize(self, rmtree, folder, ignore_errors=True)
        self.folder = folder
        (folder / STEPS).mkdir(parents=True, exist_ok=True)

    def kept(self, name: str) -> Row | None:
        """Return the kept result of a step, or None.

        Raises:
            InputError: The kept result is damaged.
        """
        file = self.folder / STEPS / f"{name}.json"
        if not file.exists():
            return None
        try:
            value = json.loads(file.read_text(encoding="utf-8"))["value"]
        except (ValueError, TypeError, LookupError):
            value = None
        if not isinstance(value, dict):
            raise InputError(f"{file} does not hold what the step computed; remove it and resume again")
        return value

    def keep(self, name: str, value: Row, seconds: float) -> Row:
        """Keep the result and the duration of a step. Return the result as it is read back."""
        plain: Row = strict(value)
        write_json(self.folder / STEPS / f"{name}.json", {"value": plain, "seconds": seconds})
        return plain

    def of(self, given: Mapping[str, Any]) -> None:
        """Keep the results of a call with these arguments, by name, and refuse a folder with results of another one.

        Raises:
            InputError: Results of other arguments, of a class of one's own before it was changed, or of another version.
        """
        from swiftwrf.runtime.digest import digest  # imports torch, which commands that compute nothing do not need

        origin = packages() | {name: digest(value) for name, value in given.items() if name not in NOT_OF_RESULTS}
        if any(file.suffix == ".json" and file.stem != ORIGIN for file in (self.folder / STEPS).iterdir()):
            check_unchanged(self.folder, self.kept(ORIGIN), origin)
        else:
            self.keep(ORIGIN, origin, seconds=0.0)

    def expect(self, steps: int) -> None:
        """Take notice of further steps, or of fewer."""

    def begin(self, name: str, title: str) -> None:
        """Take notice of a step that is computed now."""


class Steps(Generic[Context]):
    """Computations by name. `start` returns at once, and `steps[name]` computes or waits until the result is there.

    Args:
        context: First argument of each function, which is sent to each worker once.
        memo: Kept results. They are not computed again.
        executor: Workers. By default each step is computed here, in order.
        writes: Whether steps write files or read those of others, so that workers must see the memo's folder.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> def add(context, folder, number):
        ...     return {"sum": context + number}
        >>> with TemporaryDirectory() as folder:
        ...     steps = Steps(10, Memo(Path(folder)))
        ...     names = [steps.start(f"sum-{number}", "adding", add, number) for number in (1, 2)]
        ...     [steps[name]["sum"] for name in names]
        [11, 12]
    """

    def __init__(self, context: Context, memo: Memo, executor: Executor | None = None, *, writes: bool = True) -> None:
        self.memo = memo
        self._compute = partial(_compute, context, memo.folder.resolve(), writes)
        self._executor = executor
        # number of steps that workers take together; steps beyond wait, because one that others wait for may come
        self._slots: Callable[[], int] = getattr(executor, "slots", lambda: sys.maxsize)
        self._values: dict[str, Row] = {}
        self._waiting: dict[str, tuple[bool, str, tuple[Any, ...]]] = {}
        self._pending: dict[Future[tuple[Row, float]], str] = {}
        self._to_come = 0  # steps that the memo expects and that are not started

    def expect(self, steps: int) -> None:
        """Set how many more steps are started at most, so that the total of the memo does not grow."""
        self.memo.expect(steps - self._to_come)
        self._to_come = steps

    def start(self, name: str, title: str, function: Callable[..., Row], *arguments: Any, first: bool = False) -> str:
        """Let `function(context, folder, *arguments)` compute the values of a step. Return its name.

        A name that was started is not started again. With `first`, because others wait for it, the step precedes others.
        """
        if name not in self._values and name not in self._waiting and name not in self._pending.values():
            self.expect(max(self._to_come, 1))
            self._to_come -= 1
            if (value := self.memo.kept(name)) is not None:
                self._values[name] = value
                self.memo.expect(-1)
            else:
                self._waiting[name] = first, title, (function, *arguments)
        return name

    def __getitem__(self, name: str) -> Row:
        while name not in self._values:
            if not self._waiting and not self._pending:
                raise KeyError(name)
            self._advance()
        return self._values[name]

    def submit(self) -> None:
        """Send all steps to the workers, if there are any."""
        if self._executor is not None:
            self._send(self._executor, len(self._waiting))

    def _send(self, executor: Executor, number: int) -> None:
        """Send at most this number of steps to the workers."""
        for _ in range(min(number, len(self._waiting))):
            name, call = self._begun()
            with refusing_executor(executor):
                self._pending[executor.submit(self._compute, *call)] = name

    def _begun(self) -> tuple[str, tuple[Any, ...]]:
        """Return the name and the call of the step that comes next, which begins now."""
        name = min(self._waiting, key=lambda name: not self._waiting[name][0])
        _, title, call = self._waiting.pop(name)
        self.memo.begin(name, title)
        return name, call

    def _advance(self) -> None:
        """Compute a step here, or keep the results of workers that are done."""
        if self._executor is None:
            name, call = self._begun()
            self._values[name] = self.memo.keep(name, *self._compute(*call))
            return
        self._send(self._executor, self._slots() - len(self._pending))  # raises an error if all workers are lost
        for future in wait(self._pending, POLL_S, FIRST_COMPLETED).done:
            name = self._pending.pop(future)
            with refusing_executor(self._executor):
                self._values[name] = self.memo.keep(name, *future.result())


def _compute(
    context: Context, folder: Path, writes: bool, function: Callable[..., Row], *arguments: Any
) -> tuple[Row, float]:
    """Return values and seconds of a step, computed here or in a worker."""
    if writes and not (folder / STEPS).is_dir():
        raise InputError(f"a worker does not see {folder}; choose an --out on a file system that all machines share")
    began = time.perf_counter()
    return function(context, folder, *arguments), time.perf_counter() - began
