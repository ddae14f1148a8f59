"""Options of python -m tasks.locate, and their checks."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Le

from swiftwrf.choices import MAX_SUGGESTIONS
from tasks.options import OffsetSource, Options, Output, Seed, options


@options
class LocateConfig(Options):
    """Compare localizers on a split of measured RSSI, by default of the built-in simulated floor, and report their errors.

    swiftwrf resume DIR.partial continues an interrupted run. Positions of new rows: swiftwrf predict.

    Example: swiftwrf locate --rx all --data DIR
    """

    data: str | None = None
    """survey table (CSV or Parquet), folder in NeRF2 layout, or name of a public data set"""
    rx: tuple[str, ...] = ("all",)
    """receivers: names, numbers counted from 1, or all"""
    split: str = "random"
    """a split that comes with the data, or a seeded one: random or block"""
    cells: Annotated[int, Ge(10), Le(1_000_000)] = 4000
    """number of candidate positions of the posterior"""
    suggest: Annotated[int, Ge(0), Le(MAX_SUGGESTIONS)] = 0
    """number of positions to measure next that are suggested: where position errors are large and radio maps uncertain"""
    scheduler: str | None = None
    """address of a Dask scheduler whose workers compute the steps (extra: cluster)"""
    seed: Seed = 0
    """seed of everything random"""
    out: str | None = None
    """directory of the run (default: a new one under runs/locate); must not exist"""
    output: Output = Output()
    table: OffsetSource = OffsetSource()

    def check(self) -> None:
        super().check()
        self.table.check_used(self.data)
