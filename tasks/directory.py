"""The directory of a run: configuration, environment, results and report. It can be resumed until it is finished."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shlex
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from os.path import isfile  # unlike Path.is_file, it is False for names that are too long
from pathlib import Path
from typing import Any, TypeVar

import torch
from filelock import FileLock, Timeout

from swiftwrf import InputError
from swiftwrf.contrib.comparison.steps import LOCATOR, MODEL, STEPS, Memo, check_unchanged
from swiftwrf.runtime.digest import digest
from swiftwrf.runtime.durable import rename, strict, write_json
from swiftwrf.runtime.threads import set_threads
from tasks.environment import environment, invocation, now, number_of_processes, stamp
from tasks.options import by_name
from tasks.records import CONFIG, ENVIRONMENT, METRICS, PARTIAL, Row, read_json
from tasks.terminal import terminal

NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # errors of file systems without locks
LOCK = "lock"
Reported = TypeVar("Reported")
MAX_LABEL = 60  # characters of the label in the name of a directory under runs/


def kept_model(folder: Path) -> Path | None:
    """Return the file of the RSSI model or of the locator that a run keeps, None if it keeps neither."""
    return next((file for name in (MODEL, LOCATOR) if isfile(file := folder / name)), None)


def model_file(source: Path) -> Path:
    """Return the file of a model: the given one, or the one that a run of RSSI or of locating keeps.

    Raises:
        InputError: The directory of another run.
    """
    kept = kept_model(source)
    if kept is None and isfile(source / CONFIG):
        raise InputError(f"{source} is a run without an RSSI model; name one of its models, {source}/....safetensors")
    return kept or source


def begun(folder: Path) -> bool:
    """Return True if a run in this directory has written its configuration or computed a step."""
    names = {file.name for file in folder.iterdir() if not file.name.startswith(".")}
    return bool(names - {LOCK, STEPS, ENVIRONMENT}) or has_steps(folder)


def has_steps(folder: Path) -> bool:
    """Return True if a step has left a file in this directory."""
    steps = folder / STEPS
    return steps.is_dir() and any(not file.name.startswith(".") for file in steps.iterdir())


class Claim:
    """A directory that this process alone fills. The lock ends with the process.

    Args:
        folder: The directory. It is made if it does not exist.
        new: Refuse a directory in which a run has begun. Of two processes that start at once, one is refused, because
            making a directory is atomic and so is its lock.

    Raises:
        InputError: Another process works in the directory or, with `new`, a run has begun in it.
    """

    def __init__(self, folder: Path, *, new: bool) -> None:
        self.folder, self.made = folder, False
        self._new_parents = [parent for parent in folder.parents if not parent.exists()]
        if new:
            folder.parent.mkdir(parents=True, exist_ok=True)
            try:
                folder.mkdir()
                self.made = True
            except FileExistsError:
                if not (folder / LOCK).is_file():  # of another process, which may be at work
                    self._refuse_begun()
        self._lock = FileLock(folder / LOCK, thread_local=False)
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            raise InputError(f"another process is at work in {folder}; wait for it or choose another --out") from None
        except OSError as error:
            if error.errno not in NO_LOCKS:  # there, making the directory is the only guard
                raise
        if new and not self.made:
            try:
                self._refuse_begun()  # another process may have filled it before the lock was acquired
            except InputError:
                self.release()
                raise

    def _refuse_begun(self) -> None:
        if not self.folder.is_dir() or begun(self.folder):
            raise InputError(
                f"{self.folder} exists already and a run is never overwritten; choose another --out or go on with "
                f"swiftwrf resume {self.folder}"
            )

    def discard_if_empty(self) -> bool:
        """Delete the directory if it holds no result: neither steps, if this process made it, nor any file of others.

        Folders above it that it was made with go, too, unless others use them by now.

        Returns:
            True if deleted.
        """
        empty = not has_steps(self.folder) if self.made else {file.name for file in self.folder.iterdir()} <= {LOCK}
        if empty:
            shutil.rmtree(self.folder)
            with suppress(OSError):
                for parent in self._new_parents:
                    parent.rmdir()
        self.release()
        return empty

    def release(self) -> None:
        """Let other processes claim the directory."""
        self._lock.release()


def _origin(environment: Row) -> dict[str, str]:
    """Return what decides the results of a run: digests of its input, versions of packages, commit of this project."""
    found = [part for name in ("input_sha256", "packages") if isinstance(part := environment.get(name), dict)]
    return {"commit": environment.get("commit") or "unknown"} | {name: x for part in found for name, x in part.items()}


@contextmanager
def new_directory(out: Path, what: str) -> Iterator[Path]:
    """Yield a directory with a temporary name, to be filled in the block. It becomes `out` if nothing is raised.

    Raises:
        InputError: `out` exists already, or another process made it in the meantime.
    """
    if os.path.lexists(out) or not out.name:
        raise InputError(f"{out} exists already and {what} is never overwritten; choose another directory")
    out.parent.mkdir(parents=True, exist_ok=True)
    unfinished = out.with_name(f".{out.name}.{secrets.token_hex(4)}")
    unfinished.mkdir()
    try:
        yield unfinished
        if os.path.lexists(out):
            raise InputError(f"another process made {out} in the meantime; choose another directory")
        rename(unfinished, out)
    finally:
        if unfinished.exists():
            shutil.rmtree(unfinished)


def check_new_file(out: Path, suffixes: Sequence[str], option: str = "") -> None:
    """Refuse the place of a file that a command is to write.

    Raises:
        InputError: Another suffix than those that are written, `out` exists already, or its folder does not exist.
    """
    if os.path.lexists(out):
        raise InputError(f"{option}{out} exists already and is never overwritten; choose another")
    if not out.parent.is_dir():
        raise InputError(f"{option}{out} lies in {out.parent}, which is no directory")
    if out.suffix.lower() not in suffixes:
        raise InputError(
            f"{option}{out} must end in {' or '.join(suffixes)}, which can be written; choose another name"
        )


class Run(Memo):
    """The directory of a run while it is being filled.

    It is made as `NAME.partial` and renamed to `NAME` by `finish`. It keeps the result of each step, so that a resumed run
    continues after it. Only the process that made a directory deletes it, and only before a step has left a file in it.

    Args:
        task: Name of the task, which is the parent directory of runs without `--out`.
        label: Text after the time in the name of a new directory under `runs/`.
        config: Dataclass of plain values. Its `out` is the directory of the finished run, None for a new one under `runs/`.
        device: Device of the computation.
        source: SHA-256 of everything that the run reads, by name. A resumed run must find the same input.
        resume: Directory of an interrupted run to continue. Each process takes the number of threads of its beginning.
        processes: Number of processes that compute the steps, each with its share of the threads. None for that of
            `number_of_processes`, which becomes the attribute.
        described: Result of a step in words, which the terminal shows when it arrives; empty if there is nothing to show.

    Raises:
        InputError: `out` exists already, another process works in it, or the run began with other input, libraries or code.
    """

    def __init__(
        self,
        task: str,
        label: str,
        config: Any,
        device: torch.device,
        source: dict[str, str],
        resume: Path | None = None,
        processes: int | None = 1,
        described: Callable[[Row], str] = lambda value: "",
    ) -> None:
        self.described, out = described, config.out
        if resume is not None:
            self.final = resume.with_name(resume.name.removesuffix(PARTIAL))
        else:
            label = re.sub(r"[^\w.,=-]+", "_", label, flags=re.ASCII)[:MAX_LABEL]
            self.final = Path(out) if out else Path("runs") / task / f"{stamp()}-{label}"
        if not self.final.name:
            raise InputError(f"--out {out} has no name of its own; give a new directory, e.g. runs/{task}/first")
        self.folder = self.final.with_name(self.final.name + PARTIAL)
        self._refuse_existing()
        self._claim = Claim(self.folder, new=resume is None)
        try:
            self._refuse_existing()  # another process may have finished it before the claim
            super().__init__(self.folder)
            if resume is None:
                self._begin(task, config, device, source, processes)
            else:
                self._go_on(device, source, processes)
        except BaseException:
            self._claim.discard_if_empty()
            raise

    def _refuse_existing(self) -> None:
        if os.path.lexists(self.final):
            raise InputError(f"{self.final} exists already and a run is never overwritten; choose another --out")

    def _begin(
        self, task: str, config: Any, device: torch.device, source: dict[str, str], processes: int | None
    ) -> None:
        self.processes = number_of_processes(device, processes)
        set_threads(max(1, torch.get_num_threads() // self.processes))
        values = strict(by_name(config))
        self._environment = environment(device, source, self.processes) | {"config_sha256": digest(values)}
        self.write_json(ENVIRONMENT, self._environment)
        self.write_json(CONFIG, {"task": task, "command": invocation(task), "config": values})

    def _go_on(self, device: torch.device, source: dict[str, str], processes: int | None) -> None:
        self._environment = read_json(self.folder / ENVIRONMENT)
        threads = self._environment.get("threads")
        if not isinstance(threads, int) or not 1 <= threads <= 1024:
            threads = torch.get_num_threads()
        self.processes = number_of_processes(device, processes, threads)
        set_threads(threads)  # they are part of the seed
        here = environment(device, source, self.processes)
        check_unchanged(self.folder, _origin(self._environment), _origin(here))
        session = {name: here[name] for name in ("commit", "start", "processes", "device")}
        self._environment["resumed"] = [*self._environment.get("resumed", []), session]
        self.write_json(ENVIRONMENT, self._environment)

    def write_json(self, name: str, content: Any) -> None:
        """Write strict JSON: nan and infinity become null."""
        write_json(self.path(name), content)

    def of(self, given: Mapping[str, Any]) -> None:
        """Do nothing: input and versions of a run were compared when it was resumed, and its options are its own."""

    def expect(self, steps: int) -> None:
        terminal.expect(steps)

    def begin(self, name: str, title: str) -> None:
        terminal.begin(name, title)

    def keep(self, name: str, value: Row, seconds: float) -> Row:
        plain = super().keep(name, value, seconds)
        terminal.end(name, self.described(plain))
        return plain

    def computed_on(self, machines: Iterable[str]) -> None:
        """Record in the environment that these machines computed, too."""
        known = self._environment.get("workers", [])
        if not set(machines) <= set(known):
            self._environment["workers"] = sorted({*known, *machines})
            self.write_json(ENVIRONMENT, self._environment)

    def path(self, name: str) -> Path:
        """Return a file in the run's directory."""
        return self.folder / name

    def finish(self, metrics: Mapping[str, Any], report: Callable[[Path, Row], Reported]) -> Reported:
        """Write environment, report and metrics, give the run its name, and return what `report` does.

        Files that only a resumed run needs are removed last, so that a run stopped in between can be resumed.
        """
        self._environment["end"] = now()
        self.write_json(ENVIRONMENT, self._environment)
        as_read: Row = strict(metrics)
        reported = report(self.folder, as_read)
        self.write_json(METRICS, as_read)
        rename(self.folder, self.final)
        self._claim.release()
        shutil.rmtree(self.final / STEPS, ignore_errors=True)
        (self.final / LOCK).unlink(missing_ok=True)
        return reported

    def __enter__(self) -> Run:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if kind is None or not self.folder.exists():
            self._claim.release()
        elif issubclass(kind, InputError) and self._claim.discard_if_empty():
            pass
        else:
            self._claim.release()
            print(f"stopped; continue with: swiftwrf resume {shlex.quote(str(self.folder))}", file=sys.stderr)
