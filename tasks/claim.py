"""A run's directory belongs to one process at a time, and only the process that made it deletes it, while it is empty."""

from __future__ import annotations

import errno
import shutil
from os.path import isfile  # unlike Path.is_file, it is False for names that are too long
from pathlib import Path

from filelock import FileLock, Timeout

from swiftwrf import InputError
from swiftwrf.runtime.steps import STEPS

NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # errors of file systems without locks
LOCK, CONFIG, ENVIRONMENT = "lock", "config.json", "environment.json"
PARTIAL = ".partial"  # suffix of a run that is not finished
MODEL, LOCATOR = "model.safetensors", "locator.safetensors"  # fitted RSSI models of runs


def model_file(folder: Path) -> Path | None:
    """Return the file of the RSSI model or of the locator that a run keeps, None if it keeps neither."""
    return next((file for name in (MODEL, LOCATOR) if isfile(file := folder / name)), None)


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
        if new:
            folder.parent.mkdir(parents=True, exist_ok=True)
            try:
                folder.mkdir()
                self.made = True
            except FileExistsError:
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

        Returns:
            True if deleted.
        """
        empty = not has_steps(self.folder) if self.made else {file.name for file in self.folder.iterdir()} <= {LOCK}
        if empty:
            shutil.rmtree(self.folder)
        self.release()
        return empty

    def release(self) -> None:
        """Let other processes claim the directory."""
        self._lock.release()
