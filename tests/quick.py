"""The tasks on toys, with cheap stand-ins for what takes long: a whole run takes seconds, and is a real one.

As a program it is the command line of a task, for tests that kill it: `python tests/quick.py aoa --mix 0.5 --out DIR`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from unittest import mock

from augment import SYNTHESIZERS
from swiftwrf import AngularGrid, FitConfig, ModelConfig, RssiConfig, Spectra, rssi_room, simulated_room
from swiftwrf.comparison import (
    Config,
    DcganConfig,
    DcganSize,
    NeRF2Config,
    NeRF2RssiConfig,
    NeRF2RssiSize,
    NeRF2Size,
    VaeConfig,
    VaeSize,
    WrfGsConfig,
    WrfGsSize,
)
from swiftwrf.errors import LONGEST
from swiftwrf.models.geometry import GeometryConfig
from swiftwrf.models.geometry.fit import search_room
from swiftwrf.models.geometry.planes import RoomEstimate
from swiftwrf.models.geometry.search import Search
from tasks.aoa import experiment as aoa
from tasks.aoa.arms import NETWORK
from tasks.aoa.config import AoaConfig
from tasks.aoa.estimators import ESTIMATORS
from tasks.aoa.estimators.baselines import Constant
from tasks.convert import ConvertConfig
from tasks.convert import run as convert
from tasks.estimate import EstimateConfig
from tasks.estimate import run as estimate
from tasks.inspect import InspectConfig
from tasks.inspect import run as inspect
from tasks.report import ReportConfig
from tasks.report import run as report
from tasks.rssi import experiment as rssi
from tasks.rssi.predictors import PREDICTORS
from tasks.run import command_line
from tasks.scenes import ScenesConfig
from tasks.scenes import run as scenes
from tasks.view import ViewConfig
from tasks.view import run as view

FIT = FitConfig(model=ModelConfig(n_primitives=4, rank=2), steps=30, check_every=5)
SHORT = {"steps": 12, "check_every": 6, "batch": 8, "warm_up": 1}
LONGER = {"steps": 60, "check_every": 30, "batch": 16, "rate": 1e-2}  # a batch says little of so short a fit
PUBLISHED: dict[str, Config] = {  # methods of comparison, as small as they can be
    "nerf2": NeRF2Config(size=NeRF2Size(width=8, depth=6, bands=2, samples=6), rays=64, **LONGER),
    "wrfgs": WrfGsConfig(size=WrfGsSize(n_gaussians=20, width=8, depth=6, bands=2), **SHORT),
    "vae": VaeConfig(size=VaeSize(latent=2, width=2, hidden=8, bands=2), **LONGER),
    "dcgan": DcganConfig(size=DcganSize(noise=2, width=2, hidden=8, bands=2), **LONGER),
}
PUBLISHED_RSSI = NeRF2RssiConfig(size=NeRF2RssiSize(width=8, bands=2, samples=4, azimuths=4, elevations=2), **LONGER)
GLANCE = GeometryConfig(reach=0.5, positions=10, width=1, max_order=1, further=0)  # finds little, and soon
TASKS = {
    "aoa": (AoaConfig, aoa.run),
    "rssi": (rssi.RssiTaskConfig, rssi.run),
    "report": (ReportConfig, report),
    "convert": (ConvertConfig, convert),
    "estimate": (EstimateConfig, estimate),
    "inspect": (InspectConfig, inspect),
    "view": (ViewConfig, view),
    "scenes": (ScenesConfig, scenes),
}
FOR_LIFE = ExitStack()
PREDICTORS_KEPT = ("swiftwrf", "mean", "mri_pooled", "mri_receiver")


class QuickNetwork(Constant):
    """Stands in for the network; leaves a history as it does."""

    learns = True

    def fit(self, train):
        super().fit(train)
        time.sleep(0.05)
        self.history = [{"step": step, "loss": 1 / step, "seconds": 0.01} for step in (1, 2)]


@contextmanager
def small_published() -> Iterator[None]:
    """The methods of comparison in their smallest size."""
    with ExitStack() as patches:
        for name, config in PUBLISHED.items():
            made = staticmethod(lambda config=config: config)
            patches.enter_context(mock.patch.object(SYNTHESIZERS[name].make, "config", made))
        patches.enter_context(mock.patch("tasks.rssi.predictors.nerf2.NeRF2RssiConfig", return_value=PUBLISHED_RSSI))
        yield


@contextmanager
def glances() -> Iterator[None]:
    """No long search for rooms, which has tests of its own."""

    def glance(train: Spectra, config: GeometryConfig, progress: bool = False) -> RoomEstimate:
        return search_room(train, replace(GLANCE, seed=config.seed, validation=config.validation), progress)

    with (
        mock.patch("swiftwrf.models.geometry.model.search_room", glance),
        mock.patch("swiftwrf.models.geometry.fit.ENOUGH", 1),
        mock.patch.object(Search, "improve", lambda search, room: room),
    ):
        yield


@contextmanager
def quick() -> Iterator[None]:
    """Few spectra, few steps, few methods."""
    spectra = simulated_room(n=30, grid=AngularGrid.hemisphere(8, 32))
    floor = rssi_room(n=40)
    network = replace(ESTIMATORS[NETWORK], make=QuickNetwork)
    with (
        small_published(),
        glances(),
        mock.patch.object(aoa, "simulated_room", return_value=spectra),
        mock.patch.object(rssi, "rssi_room", return_value=floor),
        mock.patch("augment.synthesizers.swiftwrf.FitConfig", return_value=FIT),
        mock.patch(
            "tasks.rssi.predictors.swiftwrf.RssiConfig", lambda **given: RssiConfig(**given, steps=2, n_primitives=0)
        ),
        mock.patch("tasks.rssi.experiment.MAP_CELLS", 8),
        mock.patch.dict(ESTIMATORS._entries, {NETWORK: network}),
        mock.patch.object(
            PREDICTORS, "_entries", {name: PREDICTORS[name] for name in PREDICTORS if name in PREDICTORS_KEPT}
        ),
    ):
        yield


def run(task: str, *arguments: object) -> int:
    """A task's command line on the toy; its exit code."""
    config, function = TASKS[task]
    with quick():
        return command_line(f"tasks.{task}", config, function, [str(a) for a in arguments])


def dask_setup(worker: object) -> None:
    """The stand-ins in a Dask worker with `--preload quick`, as long as it lives."""
    FOR_LIFE.enter_context(quick())


def said(capsys) -> str:
    """The one sentence on stderr after `error:`, for tests of refusals."""
    sentences = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(sentences) == 1
    sentence = sentences[0].removeprefix("error: ")
    assert len(sentence) <= LONGEST
    return sentence


if __name__ == "__main__":
    sys.exit(run(*sys.argv[1:]))
