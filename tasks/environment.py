"""Provenance of a run: command, code, versions, machine, input."""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import subprocess
import sys
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from swiftwrf import InputError
from swiftwrf.contrib.comparison.steps import packages
from swiftwrf.runtime.threads import to_device
from tasks.preload import MAX_PROCESSES

CODE = ("swiftwrf", "augment", "tasks")  # packages whose files decide the results of a run


def stamp() -> str:
    """Return the local time, for names of new files and directories."""
    return f"{datetime.now():%Y%m%d-%H%M%S}"


def now() -> str:
    """Return the time in UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def invocation(task: str) -> str:
    """Return the command line of this process, which runs a task."""
    first, *others = sys.argv[1:] or [task]
    return command(task, *([] if first == task else [first]), *others)  # python -m tasks.aoa has no name of a task


def command(*arguments: str) -> str:
    """Return a command line of this project, quoted for a shell.

    Example:
        >>> command("view", "my run")
        "swiftwrf view 'my run'"
    """
    return shlex.join(["swiftwrf", *arguments])


def choose_device(name: str) -> torch.device:
    """Return the device of that name. With `auto` it is the GPU if there is one.

    Raises:
        InputError: There is no GPU.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return to_device(name)


def number_of_processes(device: torch.device, asked: int | None = None, threads: int = 1) -> int:
    """Return the number of processes for the steps of a run: `asked`, or up to 4 that share the threads of this process.

    Raises:
        InputError: Several on a GPU, where the number is 1.
    """
    if device.type == "cpu":
        return asked or min(max(1, torch.get_num_threads() // threads), MAX_PROCESSES)
    if (asked or 1) > 1:
        raise InputError(f"--processes {asked} is for steps on the CPU; leave it out")
    return 1


def environment(device: torch.device, source: dict[str, str], processes: int = 1) -> dict[str, Any]:
    """Return code, versions, machine and input of a run that computes its steps in this number of processes.

    The number of threads of a process belongs to the seed: it decides the order in which sums are added, and a training
    turns the last bit of a sum into degrees.
    """
    return {
        "commit": _commit(),
        "version": version("swiftwrf-tasks"),
        "python": platform.python_version(),
        "packages": packages(),
        "device": machine(device),
        "threads": torch.get_num_threads(),
        "processes": processes,
        "input_sha256": source,
        "start": now(),
    }


def _commit() -> str | None:
    """Return the commit of the code, with a digest of its changes. None if the code is in no repository of its own."""
    root = Path(__file__).parents[1]

    def git(*arguments: str) -> bytes:
        return subprocess.run(["git", *arguments], cwd=root, capture_output=True, check=True).stdout

    with suppress(OSError, subprocess.CalledProcessError):
        git("ls-files", "--error-unmatch", "tasks/environment.py")
        commit = git("describe", "--always", "--abbrev=12", "--exclude=*").decode().strip()
        changes = git("diff", "HEAD", "--binary", "--", *CODE)
        new = git("ls-files", "-z", "--others", "--exclude-standard", "--", *(f"{package}/*.py" for package in CODE))
        for name in filter(None, new.split(b"\0")):
            changes += name + (root / os.fsdecode(name)).read_bytes()
        return f"{commit}-dirty-{hashlib.sha256(changes).hexdigest()[:12]}" if changes else commit
    return None


def machine(device: torch.device) -> str:
    """Return the name of the GPU, or model and number of cores of the processor."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return f"{line.split(':', 1)[1].strip()}, {os.cpu_count()} cores"
    return f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
