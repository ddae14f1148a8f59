"""Training of the network in the processes that torchrun starts.

The first process runs the command: it alone reads, writes and reports. The others wait for calls of `distribute`, and end
with the exit code of the first process.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from datetime import timedelta
from typing import Any

import torch
from torch import distributed as dist

from swiftwrf import InputError
from swiftwrf.runtime.threads import set_threads

MAX_WAIT = timedelta(days=30)  # of the other processes, while the first process computes alone

_control: Any = None  # group that carries calls, apart from the group in which the processes train


def process_count() -> int:
    """Return the number of processes that train together, 1 without torchrun."""
    return 1 if _control is None else dist.get_world_size()


def check_gpus() -> None:
    """Refuse processes that would share a GPU.

    Raises:
        InputError: torchrun started more processes on this machine than it has GPUs.
    """
    started, gpus = int(os.environ.get("LOCAL_WORLD_SIZE", "1")), torch.cuda.device_count()
    if process_count() > 1 and started > gpus:
        raise InputError(
            f"torchrun started {started} processes on a machine of {gpus} GPUs; use --nproc-per-node {gpus} or --device cpu"
        )


def distribute(function: Callable[..., object], *arguments: Any) -> None:
    """Call a function in all other processes. The first process makes the same call itself.

    Args:
        function: Function of a module. Its result is dropped.
        arguments: Its arguments, tensors on the CPU.
    """
    _broadcast((torch.get_num_threads(), function, arguments))


def together(command: Callable[[], int]) -> int:
    """Run a command in the first process of torchrun while the others take part in its trainings.

    Returns:
        Exit code of the command, in all processes.
    """
    global _control
    alone = int(os.environ.get("WORLD_SIZE", "1")) == 1 or not dist.is_torchelastic_launched()
    if alone or _control is not None:  # the second for a command that runs others
        return command()
    if (gpu := int(os.environ["LOCAL_RANK"])) < torch.cuda.device_count():
        torch.cuda.set_device(gpu)
    dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")
    _control = dist.new_group(backend="gloo", timeout=MAX_WAIT)
    try:
        return _lead(command) if dist.get_rank() == 0 else _follow()
    finally:
        _control = None
        dist.destroy_process_group()


def _lead(command: Callable[[], int]) -> int:
    code = 1
    try:
        code = command()
    except SystemExit as end:  # raised by the parser of the command line
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
        raise
    finally:
        with suppress(RuntimeError):  # a process that is gone has ended the others, too
            _broadcast(code)
    return code


def _follow() -> int:
    while True:
        order = _broadcast(None)
        if isinstance(order, int):
            return order
        threads, function, arguments = order
        set_threads(threads)
        function(*arguments)


def _broadcast(order: Any) -> Any:
    """Return the order of the first process, in all processes."""
    orders = [order]
    dist.broadcast_object_list(orders, src=0, group=_control)
    return orders[0]
