"""The processes that torchrun started. The first runs the command: it alone reads, claims the run's directory, writes and
speaks. The others wait for the steps that are computed together, and end with its exit code."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from datetime import timedelta
from typing import Any

import torch
from torch import distributed as dist

from swiftwrf import FitError, InputError
from swiftwrf.runtime.threads import set_threads

PATIENCE = timedelta(days=30)  # that the others have while the first one computes alone

_others: Others | None = None


class Others:
    """All processes but the first, as the first one sees them.

    Args:
        control: the group over which they are told what to do. What they compute has another, so that a process that
            fails in the middle of it is no answer to anything.
    """

    def __init__(self, control: dist.ProcessGroup) -> None:
        self._control, self._common = control, None

    def call(self, function: Callable[..., object], common: Any, *arguments: Any) -> None:
        """Lets each of them call the function, with as many threads as here; this process is to do the same.

        Args:
            function: what they call; results are dropped.
            common: its first argument; sent once for many calls.
            arguments: the others.
        """
        known = common is self._common
        self._common = common
        _broadcast((torch.get_num_threads(), function, None if known else common, arguments), self._control)

    def dismiss(self, code: int) -> None:
        """Lets them end with this exit code."""
        with suppress(RuntimeError):  # one that is gone ended the others, too
            _broadcast(code, self._control)


def others() -> Others | None:
    """The other processes; None in one that is alone, and in them."""
    return _others


def group() -> dist.ProcessGroup | None:
    """The processes that torchrun started, for what they compute together; None for one that is alone."""
    return dist.group.WORLD if dist.is_initialized() else None


def check_gpus() -> None:
    """Refuses processes that would have to share a GPU.

    Raises:
        InputError: more processes than GPUs on this machine.
    """
    started, gpus = int(os.environ.get("LOCAL_WORLD_SIZE", "1")), torch.cuda.device_count()
    if _others is not None and started > gpus:
        raise InputError(
            f"torchrun started {started} processes on a machine of {gpus} GPUs; use --nproc-per-node {gpus} or --device cpu"
        )


def together(command: Callable[[], int]) -> int:
    """Runs the command in the first of the processes that torchrun started, and lets the others help; without them, just
    runs it. The exit code is that of the command, in all of them."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1 or not dist.is_torchelastic_launched():
        return command()
    gpu = int(os.environ["LOCAL_RANK"])
    if gpu < torch.cuda.device_count():
        torch.cuda.set_device(gpu)
    own = not dist.is_initialized()
    if own:
        dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo", timeout=PATIENCE)
    control: Any = dist.new_group(backend="gloo", timeout=PATIENCE)
    try:
        return _lead(command, control) if dist.get_rank() == 0 else _help(control)
    finally:
        if own:
            dist.destroy_process_group()


def _lead(command: Callable[[], int], control: dist.ProcessGroup) -> int:
    """Runs the command, then lets the others end; its exit code."""
    global _others
    _others, code = Others(control), 1
    try:
        code = command()
    except SystemExit as end:  # of what parses the command line
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
        raise
    finally:
        _others.dismiss(code)
        _others = None
    return code


def _help(control: dist.ProcessGroup) -> int:
    """Does what the first process says; its exit code."""
    common = None
    while True:
        order = _broadcast(None, control)
        if isinstance(order, int):
            return order
        threads, function, new, arguments = order
        common = common if new is None else new
        set_threads(threads)
        with suppress(InputError, FitError):  # the first one meets and says it, too
            function(common, *arguments)


def _broadcast(order: Any, control: dist.ProcessGroup) -> Any:
    """What the first process says, in all of them."""
    said = [order]
    dist.broadcast_object_list(said, src=0, group=control)
    return said[0]
