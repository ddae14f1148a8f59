"""Options of both uses of the command: the experiment, and the positions of new observations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import tyro

from swiftwrf.choices import MAX_SUGGESTIONS
from swiftwrf.errors import InputError
from tasks.options import OffsetSource, Options, Output, SpectraSource, command_options, given


@dataclass(frozen=True, kw_only=True)
class ExperimentOptions(Options):
    """Options of the experiment."""

    group: ClassVar[str] = "experiment"

    data: str | None = None
    """survey table (CSV or Parquet), folder in NeRF2 layout, or name of a public data set"""
    rx: tuple[str, ...] = ("all",)
    """receivers: names, numbers counted from 1, or all"""
    split: str = "random"
    """a split that comes with the data, or a seeded one: random or block"""
    cells: int = 4000
    """number of candidate positions of the posterior"""
    suggest: int = 0
    """number of positions to measure next that are suggested: where position errors are large and radio maps uncertain"""
    scheduler: str | None = None
    """address of a Dask scheduler whose workers compute the steps (extra: cluster)"""
    seed: int = 0
    """seed of everything random"""


@command_options
class LocateConfig(ExperimentOptions, SpectraSource, OffsetSource, Output):
    """Positions of a transmitter from RSSI or spectra.

    Without MODEL and SOURCE: compare localizers on a split of measured RSSI, by default of the built-in simulated floor, and
    report their errors. Continue an interrupted run with --resume DIR.partial.

    With MODEL and SOURCE: write the positions of new observations to a table.

    Example: python -m tasks.locate --rx all --data DIR
    """

    resumable: ClassVar[bool] = True

    model: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[MODEL]")] = None
    """file of a locator of RSSI or spectra, e.g. runs/locate/first/locator.safetensors"""
    source: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[SOURCE]")] = None
    """RSSI of any format that tasks.rssi takes, a table without positions included; or spectra of any format that tasks.aoa
    takes, or a .npy file (n, elevations, azimuths) of magnitudes in [0, 1]"""
    track: float | None = None
    """rows of SOURCE are a walk: smooths its positions by this typical speed [m/s]. Rows without times are 1 s apart"""
    out: str | None = None
    """directory of the run or table (default: a new directory under runs/locate, or positions-TIME.csv); must not exist"""

    def check(self) -> None:
        super().check()
        if self.model is not None and self.source is None:
            raise InputError(
                f"{self.model} needs observations: python -m tasks.locate MODEL SOURCE; the experiment takes options only, "
                "e.g. --data"
            )
        if self.model is None and self.track is not None:
            raise InputError("--track is for observations; give it with MODEL and SOURCE")
        if self.model is None and (names := given(self, SpectraSource)):
            raise InputError(f"--{names[0]} is for spectra; give it with MODEL and SOURCE")
        if self.model is not None and (names := given(self, ExperimentOptions, OffsetSource)):
            raise InputError(f"--{names[0]} is for the experiment; leave it out with MODEL and SOURCE")
        if self.model is None:
            self.check_used(self.data)
        if not 10 <= self.cells <= 1_000_000:
            raise InputError(f"--cells takes 10 to 1,000,000, got {self.cells}")
        if not 0 <= self.suggest <= MAX_SUGGESTIONS:
            raise InputError(f"--suggest takes 0 to {MAX_SUGGESTIONS} positions, got {self.suggest}")
