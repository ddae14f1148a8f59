"""Where a run computes: code, versions, machine, input."""

from __future__ import annotations

import os
import platform
import subprocess
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torch import distributed as dist


def now() -> str:
    """The time in UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def environment(device: torch.device, source: dict[str, str]) -> dict[str, Any]:
    """Code, versions, machine and input of a run.

    The number of threads belongs to the seed: sums over threads are added up in another order, and a training turns the
    last bit of a sum into degrees. So does the number of processes, which add up sums, too.
    """
    return {
        "commit": _commit(),
        "version": version("swiftwrf-tasks"),
        "python": platform.python_version(),
        "packages": packages(),
        "device": machine(device),
        "threads": torch.get_num_threads(),
        "processes": dist.get_world_size() if dist.is_initialized() else 1,
        "input_sha256": source,
        "start": now(),
    }


def packages() -> dict[str, str]:
    """Versions of the libraries that numbers come from."""
    names = ("torch", "torchvision", "numpy", "scipy", "scikit-learn", "numba")
    return {name: version(name) for name in names}


def _commit() -> str | None:
    """Of the repository the code runs from, marked where files differ from it; None outside a repository."""
    with suppress(OSError, subprocess.CalledProcessError):
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"],
            cwd=Path(__file__).parent, capture_output=True, text=True, check=True,
        )  # fmt: skip
        return described.stdout.strip()
    return None


def machine(device: torch.device) -> str:
    """Name of the GPU, or model and number of cores of the processor."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return f"{line.split(':', 1)[1].strip()}, {os.cpu_count()} cores"
    return f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
