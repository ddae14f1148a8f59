"""Options of python -m tasks.convert, and their checks."""

from __future__ import annotations

from typing import Annotated

import tyro

from swiftwrf.errors import InputError
from tasks.options import SpectraSource, TableSource, command_options


@command_options
class ConvertConfig(SpectraSource, TableSource):
    """Convert measurements of any known format to the toolkit's own layout (see docs/formats.md).

    Example: python -m tasks.convert DIR converted --calibrate
    """

    source: Annotated[str, tyro.conf.Positional]
    """folder or file of measurements"""
    out: Annotated[str, tyro.conf.Positional]
    """directory to write; must not exist"""
    calibrate: bool = False
    """whether to estimate the elements' phases and the array's orientation from the training positions of array snapshots,
    and to correct them"""
    split: str | None = None
    """with --calibrate: split whose training part is used (default: random); it is written beside the spectra"""
    seed: int = 0
    """seed of that split"""

    def check(self) -> None:
        super().check()
        if (self.split is not None or self.seed) and not self.calibrate:
            raise InputError("--split and --seed are of the calibration; give --calibrate, too")
