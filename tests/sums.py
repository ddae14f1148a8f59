"""Steps that add numbers, for tests of processes: children import them by this name."""

import os
import signal
import time
from dataclasses import dataclass

import torch

from swiftwrf import InputError
from swiftwrf.runtime.steps import Step
from tasks.configs import AoaConfig
from tasks.directory import Run
from tasks.steps import run_steps


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


class KillOnce(Sum):
    """A step that ends the first process that computes it."""

    def compute(self, context, folder):
        if not (folder / "killed").exists():
            (folder / "killed").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().compute(context, folder)


class Sleep(Sum):
    def compute(self, context, folder):
        time.sleep(60)


class Exit(Sum):
    def compute(self, context, folder):
        os._exit(3)


STEPS = [Sum(1, (3, 4)), Sum(2), Sum(1, (5,))]  # the third is the first one, and has another follower


def results(folder, steps, processes=1, cluster=None, resume=None, act=lambda: None):
    """Run steps. Return them with their results, and the names in the order of arrival; `act` is called at each arrival."""
    arrived = []

    def show(step, value):
        arrived.append(step.name)
        act()

    config = AoaConfig(mix=(0.5,))
    with Run("aoa", str(folder), "", config, torch.device("cpu"), {}, resume, processes) as run:
        found = list(run_steps(run, steps, 10, cluster, show))
        run.finish({}, lambda folder, metrics: None)
    return found, arrived
