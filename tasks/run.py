"""Context of an experiment: its directory, its console and its device."""

from __future__ import annotations

import torch

from swiftwrf.runtime.threads import to_device
from swiftwrf.runtime.validation import Preset
from tasks.directory import Run
from tasks.records import Row
from tasks.terminal import console
from tasks.torchrun import check_gpus


def choose_device(name: str) -> torch.device:
    """Return the device of that name. With `auto` it is the GPU if there is one.

    Raises:
        InputError: There is no GPU, or there are fewer GPUs than processes of torchrun.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    device = to_device(name)
    if device.type == "cuda":
        check_gpus()
    return device


__all__ = ["Preset", "Row", "Run", "choose_device", "console"]
