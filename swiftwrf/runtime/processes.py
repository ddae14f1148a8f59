"""Several processes that train one model, each with its part of every batch: torch.distributed, one process a GPU."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch import distributed as dist

from swiftwrf.errors import InputError

Found = TypeVar("Found")


class Processes:
    """Those of a group; without a group this process is alone, and nothing here costs or changes anything.

    Args:
        group: of `torch.distributed`. All its processes do the same, in the same order.
    """

    def __init__(self, group: dist.ProcessGroup | None = None) -> None:
        self.group = group
        self.number = dist.get_world_size(group) if group else 1
        self.rank = dist.get_rank(group) if group else 0

    @property
    def first(self) -> bool:
        """Whether this is the one that writes and speaks."""
        return self.rank == 0

    def own(self, rows: Tensor) -> Tensor:
        """This process's part of the rows of a batch."""
        return rows[self.rank :: self.number]

    def weight(self, rows: int) -> float:
        """By what to multiply the mean over the own part, so that its average over the processes is the mean over the batch.

        Raises:
            InputError: fewer rows than processes.
        """
        if rows < self.number:
            raise InputError(f"{self.number} processes cannot share batches of {rows} spectra; start at most {rows}")
        return len(range(self.rank, rows, self.number)) * self.number / rows

    def average(self, tensors: Iterable[Tensor]) -> None:
        """Each becomes its mean over the processes, in place; they travel in one message."""
        if self.group is not None:
            tensors = list(tensors)
            flat = torch.cat([tensor.flatten() for tensor in tensors])
            dist.all_reduce(flat, group=self.group)
            flat /= self.number
            for tensor, mean in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
                tensor.copy_(mean.view_as(tensor))

    def total(self, tensor: Tensor) -> Tensor:
        """Its sum over the processes, differentiable."""
        return tensor if self.group is None else _Total.apply(tensor, self.group)

    def from_first(self, find: Callable[[], Found]) -> Found:
        """What the first process finds, in all of them.

        Raises:
            InputError: that of the first process, in all of them.
        """
        found: list[Any] = [None, None]
        if self.first:
            try:
                found[0] = find()
            except InputError as error:
                found[1] = error
        if self.group is not None:
            dist.broadcast_object_list(found, dist.get_global_rank(self.group, 0), group=self.group)
        if found[1] is not None:
            raise found[1]
        value: Found = found[0]
        return value


class _Total(torch.autograd.Function):
    """The sum over the processes; so is its gradient, for what each of them loses depends on it."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, group: dist.ProcessGroup) -> Tensor:
        ctx.group = group
        total = tensor.clone()
        dist.all_reduce(total, group=group)
        return total

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return _Total.forward(ctx, gradient, ctx.group), None
