"""Options of python -m tasks.rssi, and their checks."""

from __future__ import annotations

from typing import Literal

from swiftwrf.choices import RSSI_PREDICTORS, NotDetected
from swiftwrf.errors import InputError
from swiftwrf.runtime.validation import Preset
from tasks.options import OffsetSource, Options, Output, Seed, options


@options
class RssiTaskConfig(Options):
    """RSSI of a moving transmitter at fixed receivers, against baselines.

    Without --data the built-in simulated floor is used. swiftwrf resume DIR.partial continues an interrupted run.

    Example: swiftwrf rssi --rx 6 --data DIR
    """

    rx: tuple[str, ...]
    """receivers: names, numbers counted from 1, or all"""
    data: str | None = None
    """survey table (CSV or Parquet), folder with tx_pos.csv, gateway_rssi.csv and gateway_position.yml (NeRF2 layout), or
    name of a public data set, see docs/formats.md"""
    split: str = "random"
    """a split that comes with the data, or a seeded one: random, block, or place (a fifth of the receivers is held out)"""
    also: tuple[str, ...] = ()
    """predictors that are compared only when named: nerf2 and blend take minutes; pairs and knn_pairs are for data with both
    ends moving, where they are compared anyway"""
    not_detected: NotDetected = "auto"
    """meaning of an empty cell: weak, the signal was below the limit of detection; unknown, it is ignored; auto decides for
    each receiver by the data"""
    validation: Literal["auto", "random", "block", "session"] = "auto"
    """folds of the training rows that choose all settings; auto takes those that are like the test rows"""
    preset: Preset = "quick"
    """of SwiftWRF and NeRF2: quick, or paper for the published head and field"""
    floor_plan: str | None = None
    """an image to draw behind the maps, PNG or JPEG"""
    floor_extent: tuple[float, float, float, float] | None = None
    """x0 x1 y0 y1 of that image [m] (default: as pixels of the image are the positions in the table)"""
    scheduler: str | None = None
    """address of a Dask scheduler whose workers fit groups of receivers (extra: cluster)"""
    seed: Seed = 0
    """seed of everything random"""
    out: str | None = None
    """directory of the run; must not exist (default: a new one under runs/rssi)"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """where to compute; RSSI models are small, so auto is the CPU"""
    output: Output = Output()
    table: OffsetSource = OffsetSource()

    def check(self) -> None:
        super().check()
        for name in self.also:
            RSSI_PREDICTORS.check(name)
        self.table.check_used(self.data)
        if self.floor_plan is None and self.floor_extent is not None:
            raise InputError("--floor-extent needs --floor-plan FILE")
        if self.floor_extent is not None:
            x0, x1, y0, y1 = self.floor_extent
            if not (x0 < x1 and y0 < y1):
                raise InputError(
                    f"--floor-extent must be x0 x1 y0 y1 with x0 < x1 and y0 < y1, got {self.floor_extent}"
                )
