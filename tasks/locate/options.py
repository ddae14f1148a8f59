"""Options of python -m tasks.locate, and their checks."""

from __future__ import annotations

from swiftwrf.choices import MAX_SUGGESTIONS
from swiftwrf.errors import InputError
from tasks.options import OffsetSource, Options, Output, options


@options
class LocateConfig(Options):
    """Compare localizers on a split of measured RSSI, by default of the built-in simulated floor, and report their errors.

    swiftwrf resume DIR.partial continues an interrupted run. Positions of new rows: python -m tasks.predict.

    Example: python -m tasks.locate --rx all --data DIR
    """

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
    out: str | None = None
    """directory of the run (default: a new one under runs/locate); must not exist"""
    output: Output = Output()
    table: OffsetSource = OffsetSource()

    def check(self) -> None:
        super().check()
        self.table.check_used(self.data)
        if not 10 <= self.cells <= 1_000_000:
            raise InputError(f"--cells takes 10 to 1,000,000, got {self.cells}")
        if not 0 <= self.suggest <= MAX_SUGGESTIONS:
            raise InputError(f"--suggest takes 0 to {MAX_SUGGESTIONS} positions, got {self.suggest}")
