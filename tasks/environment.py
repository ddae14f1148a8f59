"""Provenance of a run: command, code, versions, machine, input."""

from __future__ import annotations

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

from tasks.torchrun import process_count


def now() -> str:
    """Return the time in UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def invocation(task: str) -> str:
    """Return the command line of this process, which runs a task."""
    program, *arguments = sys.argv
    if Path(program).stem == "swiftwrf":
        return shlex.join(["swiftwrf", *arguments])
    return shlex.join(["python", "-m", f"tasks.{task}", *arguments])


def environment(device: torch.device, source: dict[str, str]) -> dict[str, Any]:
    """Return code, versions, machine and input of a run.

    The numbers of threads and processes belong to the seed: they decide the order in which sums are added, and a training
    turns the last bit of a sum into degrees.
    """
    return {
        "commit": _commit(),
        "version": version("swiftwrf-tasks"),
        "python": platform.python_version(),
        "packages": packages(),
        "device": machine(device),
        "threads": torch.get_num_threads(),
        "processes": process_count(),
        "input_sha256": source,
        "start": now(),
    }


def packages() -> dict[str, str]:
    """Return the versions of this project and of the libraries on which results depend."""
    names = ("swiftwrf-tasks", "torch", "torchvision", "numpy", "scipy", "scikit-learn", "numba")
    return {name: version(name) for name in names}


def _commit() -> str | None:
    """Return the commit of the code, marked if files differ from it. None if the code is in no repository of its own."""
    own = Path(__file__)
    describe = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    with suppress(OSError, subprocess.CalledProcessError):
        for command in (["git", "ls-files", "--error-unmatch", own.name], describe):
            done = subprocess.run(command, cwd=own.parent, capture_output=True, text=True, check=True)
        return done.stdout.strip()
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
