"""Steps that add numbers, for tests of processes: children import them by this name."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass

import torch

from swiftwrf import InputError
from tasks.steps import Step


@dataclass(frozen=True)
class Sum(Step[int]):
    """Add the context to a number; larger numbers follow."""

    number: int
    following: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        return f"sum-{self.number}"

    def compute(self, context, folder):
        (folder / f"{self.name}.txt").write_text(str(self.number))
        return {"sum": self.number + context, "process": os.getpid(), "threads": torch.get_num_threads()}

    def then(self, context, value):
        return [Sum(number) for number in self.following]


class Refusal(Sum):
    def compute(self, context, folder):
        raise InputError("no such number")


class Kill(Sum):
    def compute(self, context, folder):
        os.kill(os.getpid(), signal.SIGKILL)


class Exit(Sum):
    def compute(self, context, folder):
        os._exit(3)


class Optional(Sum):
    """A step that a budget may leave out."""

    is_optional = True
