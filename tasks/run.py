"""Context of an experiment: its directory, its console and its device."""

from __future__ import annotations

import torch

from swiftwrf.runtime.threads import to_device
from swiftwrf.runtime.validation import Preset
from tasks.directory import Run
from tasks.records import Row
from tasks.terminal import console


def choose_device(name: str) -> torch.device:
    """Return the device of that name. With `auto` it is the GPU if there is one.

    Raises:
        InputError: There is no GPU.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return to_device(name)


__all__ = ["Preset", "Row", "Run", "choose_device", "console"]
