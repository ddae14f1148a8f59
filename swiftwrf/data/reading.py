"""What a user may say of files, where they leave it open."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.planar import PlanarArray


@dataclass(frozen=True)
class Reading:
    """How files are read; every format says which of these it takes, and the others are refused there.

    Args:
        array: that took the spectra, or that ray paths are computed for (4 x 4 at half a wavelength unless given).
        beamformer: that makes spectra of array snapshots (`phase` unless given).
        grid: directions of computed spectra (90 x 360 unless given).
        every: takes one measurement of so many.
        station: which array of a file with several, counted from 1.
        columns: what the columns of a table are called there, by what they hold.
    """

    array: PlanarArray | None = None
    beamformer: str | None = None
    grid: AngularGrid | None = None
    every: int | None = None
    station: int | None = None
    columns: Mapping[str, str] | None = None

    @property
    def given(self) -> list[str]:
        """Names of what was said."""
        return [field.name for field in fields(self) if getattr(self, field.name) is not None]
