"""The tasks on toys, with cheap stand-ins for what takes long: a whole run takes seconds, and is a real one.

As a program it is the command line of a task, for tests that kill it: `python tests/quick.py aoa --mix 0.5 --out DIR`.
"""

import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from functools import cache
from importlib import import_module
from pathlib import Path
from unittest import mock

from matplotlib.figure import Figure
from small import FEW_CELLS, glances, known_planes, only, small

from augment.estimators import ESTIMATORS, kernel_regression
from augment.estimators.baselines import Constant
from augment.turbo.condition import NETWORKS
from swiftwrf import AngularGrid, Rssi, Spectra, rssi_room, simulated_room
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.errors import MAX_LENGTH
from tasks import configs
from tasks.aoa import experiment as aoa
from tasks.aoa import synthesis
from tasks.aoa.records import FractionRecords
from tasks.command import COMMANDS
from tasks.command_line import command_line
from tasks.locate import experiment as locate
from tasks.rssi import experiment as rssi

TASKS = {
    name: (getattr(configs, command.options), import_module(command.module).run) for name, command in COMMANDS.items()
}
FOR_LIFE = ExitStack()


class QuickNetwork(Constant):
    """Stand-in for the network that leaves a history."""

    trainable = True

    def _fit(self, train, device):
        super()._fit(train, device)
        time.sleep(0.05)
        self.history = [{"step": step, "loss": 1 / step, "seconds": 0.01} for step in (1, 2)]


@contextmanager
def sketched() -> Iterator[None]:
    """Write reports with empty figures, which otherwise take most of the time of a small run."""

    def outline(figure: Figure, title: str | None = None) -> str:
        return "<svg></svg>\n"

    with mock.patch("tasks.page.page.as_svg", outline), one_example():
        yield


@contextmanager
def one_example() -> Iterator[None]:
    """Write reports with one example of a spectrum, each of which takes as long as the other figures."""

    def first(fraction: FractionRecords) -> list[tuple[synthesis.Images, str, synthesis.Direction | None]]:
        return every(fraction)[:1]

    every = synthesis.examples
    with mock.patch.object(synthesis, "examples", first):
        yield


@contextmanager
def cheap() -> Iterator[None]:
    """Small parts for runs and examples on any data: glances for rooms, few primitives, cells and predictors, no network."""
    with (
        glances(),
        small("primitives", "cells", "kernels", "distributions", "path gains", "furniture", "maps"),
        mock.patch("augment.turbo.stages.HELD_OUT_LOCATOR", FEW_CELLS),
        mock.patch.multiple(kernel_regression, MAX_ROWS=400, MAX_CHOICE_ROWS=150),
        only(ESTIMATORS, *ESTIMATORS, **dict.fromkeys(NETWORKS.values(), QuickNetwork)),
        only(RSSI_PREDICTORS, "swiftwrf", "mean", "mri_pooled", "mri_receiver"),
    ):
        yield


@cache
def toys() -> tuple[Spectra, Rssi, Rssi]:
    """The data of tasks that are given none: for angles, for maps of RSSI and for positions."""
    return simulated_room(n=30, grid=AngularGrid.hemisphere(8, 32)), rssi_room(n=40), rssi_room(n=80)


@contextmanager
def quick(drawn: bool = False) -> Iterator[None]:
    """Few spectra, few steps, few methods, no planes; figures if asked for."""
    spectra, floor, located = toys()
    with (
        cheap(),
        small("published"),
        known_planes(),
        mock.patch.object(aoa, "simulated_room", return_value=spectra),
        mock.patch.object(rssi, "rssi_room", return_value=floor),
        mock.patch.object(locate, "rssi_room", return_value=located),
        one_example() if drawn else sketched(),
    ):
        yield


def command(task: str, *arguments: object) -> int:
    """A task's command line; its exit code."""
    config, function = TASKS[task]
    return command_line(f"tasks.{task}", config, function, [str(a) for a in arguments])


def run(task: str, *arguments: object, drawn: bool = False) -> int:
    """A task's command line on the toy; its exit code."""
    with quick(drawn):
        return command(task, *arguments)


@contextmanager
def recorded(folder: Path) -> Iterator[None]:
    """Keep what a run prints in out.txt and err.txt of the folder, for the tests that read it."""
    with (
        (folder / "out.txt").open("w") as out,
        (folder / "err.txt").open("w") as err,
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        yield


def dask_setup(worker: object) -> None:
    """The stand-ins in a Dask worker with `--preload quick`, as long as it lives."""
    FOR_LIFE.enter_context(quick())


def said(capsys) -> str:
    """The one sentence on stderr after `error:`, for tests of refusals."""
    sentences = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(sentences) == 1
    sentence = sentences[0].removeprefix("error: ")
    assert len(sentence) <= MAX_LENGTH
    return sentence


if __name__ == "__main__":
    sys.exit(run(*sys.argv[1:]))
