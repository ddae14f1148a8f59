"""Steps that add numbers, for tests of processes: children import them by this name."""

import os
import signal
import time
from collections.abc import Callable
from typing import NamedTuple

import torch

from swiftwrf import InputError
from swiftwrf.contrib.comparison.steps import Steps
from tasks.configs import AoaConfig
from tasks.directory import Run
from tasks.workers import workers_of


class Sum(NamedTuple):
    """A step that adds the context to a number, by a function; larger numbers follow."""

    number: int
    following: tuple[int, ...] = ()
    function: Callable[..., dict[str, int]] | None = None

    @property
    def name(self) -> str:
        return f"sum-{self.number}"


def add(context, folder, number):
    (folder / f"sum-{number}.txt").write_text(str(number))
    return {"sum": number + context, "process": os.getpid(), "threads": torch.get_num_threads()}


def refuse(context, folder, number):
    raise InputError("no such number")


def kill(context, folder, number):
    os.kill(os.getpid(), signal.SIGKILL)


def kill_once(context, folder, number):
    """End the first process that computes it."""
    if not (folder / "killed").exists():
        (folder / "killed").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return add(context, folder, number)


def sleep(context, folder, number):
    time.sleep(60)


def leave(context, folder, number):
    os._exit(3)


STEPS = [Sum(1, (3, 4)), Sum(2), Sum(1, (5,))]  # the third is the first one, and has another follower


def results(folder, given, processes=1, cluster=None, resume=None, act=lambda: None):
    """Run steps. Return their names and results, and the names in the order of arrival; `act` is called at each arrival."""
    arrived = []

    def show(value):
        arrived.append(value)
        act()
        return ""

    config = AoaConfig(measured=(0.5,), out=str(folder))
    with Run("aoa", "", config, torch.device("cpu"), {}, resume, processes, show) as run:
        with workers_of(run, cluster) as workers:
            steps = Steps(10, run, workers)
            started = [
                (steps.start(one.name, one.name, one.function or add, one.number), one.following) for one in given
            ]
            found = []
            for name, following in started:
                found.append((name, steps[name]))
                for number in following:
                    follower = steps.start(f"sum-{number}", "a larger number", add, number)
                    found.append((follower, steps[follower]))
        run.finish({}, lambda folder, metrics: None)
    return found, [f"sum-{value['sum'] - 10}" for value in arrived]
