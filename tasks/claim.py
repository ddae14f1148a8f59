"""The directory of a run belongs to one process at a time, and is deleted only by who made it while it holds nothing."""

from __future__ import annotations

import errno
import os
import shutil
import sys
from pathlib import Path

from swiftwrf import InputError

if sys.platform != "win32":
    import fcntl

LOCK, STEPS, CONFIG, ENVIRONMENT = "lock", "steps", "config.json", "environment.json"
REFUSED = (errno.EAGAIN, errno.EACCES)  # what a lock that somebody else holds answers


def begun(folder: Path) -> bool:
    """Whether a run in this directory got so far that something would be lost with it: its configuration is written
    before anything is computed."""
    names = {file.name for file in folder.iterdir() if not file.name.startswith(".")}
    return bool(names - {LOCK, STEPS, ENVIRONMENT}) or has_steps(folder)


def has_steps(folder: Path) -> bool:
    """Whether a step has left something in this directory."""
    steps = folder / STEPS
    return steps.is_dir() and any(not file.name.startswith(".") for file in steps.iterdir())


class Claim:
    """A directory that this process alone fills; the lock ends with the process, whatever ends it.

    Args:
        folder: the directory; made unless it is there.
        new: refuse a directory in which a run has begun. Making a directory is atomic, and so is the lock: of two
            processes that come at once, one is refused.

    Raises:
        InputError: somebody else is at work in it, or (where `new`) a run has begun in it.
    """

    def __init__(self, folder: Path, *, new: bool) -> None:
        self.folder, self.made = folder, False
        if new:
            folder.parent.mkdir(parents=True, exist_ok=True)
            try:
                folder.mkdir()
                self.made = True
            except FileExistsError:
                self._refuse_begun()
        self._lock: int | None = self._take()
        if new and not self.made:
            self._refuse_begun()  # somebody may have filled it before the lock was ours

    def _refuse_begun(self) -> None:
        if not self.folder.is_dir() or begun(self.folder):
            self.release()
            raise InputError(
                f"{self.folder} exists already and a run is never overwritten; choose another --out or go on with "
                f"--resume {self.folder}"
            )

    def _take(self) -> int:
        lock = self.folder / LOCK
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            if sys.platform != "win32":
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.stat(lock).st_ino == os.fstat(descriptor).st_ino:
                return descriptor
        except FileNotFoundError:  # the other process finished and gave the directory its name
            pass
        except OSError as error:
            if error.errno not in REFUSED:  # a file system without locks: the directory's making must do
                return descriptor
        os.close(descriptor)
        raise InputError(f"another process is at work in {self.folder}; wait for it or choose another --out") from None

    def discard_if_nothing_is_lost(self) -> bool:
        """Deletes the directory if this process made it and no step has left anything in it; whether it did."""
        nothing = self.made and not has_steps(self.folder)
        if nothing:
            shutil.rmtree(self.folder)
        self.release()
        return nothing

    def release(self) -> None:
        """Lets others have the directory."""
        lock, self._lock = getattr(self, "_lock", None), None
        if lock is not None:
            os.close(lock)
