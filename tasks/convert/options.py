"""Options of python -m tasks.convert, and their checks."""

from __future__ import annotations

from pathlib import PurePath
from typing import Annotated

import tyro

from swiftwrf.errors import InputError
from swiftwrf.runtime.validation import PositiveFloat
from tasks.options import Answered, Options, Seed, SpectraSource, TableSource, options

FILES = (".csv", ".mat", ".tif", ".geojson", ".png")  # suffixes of files; other names are directories
MAPS = (".tif", ".geojson", ".png")  # suffixes of files that hold a map only


@options
class ConvertConfig(Options):
    """Convert measurements and RSSI maps: OUT is a directory in the toolkit's own layout, or a file.

    SOURCE is measurements of any known format (see docs/formats.md), the directory of a run of tasks.rssi or tasks.locate,
    or a saved RSSI model.

    Example: swiftwrf convert DIR converted --calibrate

    Example: swiftwrf convert runs/rssi/first map.tif
    """

    source: Annotated[str, tyro.conf.Positional]
    """folder or file of measurements, name of a public data set, directory of a run, or saved RSSI
    model"""
    out: Annotated[str, tyro.conf.Positional]
    """directory to write, or file: .csv, .mat, and of RSSI maps .tif (GeoTIFF), .geojson, .png (with a world file); must
    not exist"""
    calibrate: bool = False
    """whether to estimate the elements' phases and the array's orientation from the training positions of array snapshots,
    and to correct them"""
    split: str | None = None
    """with --calibrate: split whose training part is used (default: random); it is written beside the spectra"""
    seed: Seed = 0
    """seed of that split"""
    deepmimo: bool = False
    """write ray paths (paths.npz) as a folder of DeepMIMO v4"""
    rx: tuple[str, ...] = ()
    """receivers of the map, names or numbers counted from 1 (default: all); a .png shows the strongest of them"""
    cell: PositiveFloat | None = None
    """edge of the map's cells [m] (default: 1/120 of the longer side)"""
    height: float | None = None
    """height of the transmitter on the map [m] (default: the median of the training positions)"""
    output: Answered = Answered()
    spectra: SpectraSource = SpectraSource()
    table: TableSource = TableSource()

    @property
    def suffix(self) -> str:
        """Suffix of the file to write, empty for a directory."""
        suffix = PurePath(self.out).suffix.lower()
        return suffix if suffix in FILES else ""

    def check(self) -> None:
        super().check()
        if (self.split is not None or self.seed) and not self.calibrate:
            raise InputError("--split and --seed are of the calibration; give --calibrate, too")
        if self.deepmimo and self.suffix:
            raise InputError(f"--deepmimo writes a folder; give a directory instead of {self.out}")
        if self.calibrate and (self.suffix or self.deepmimo):
            raise InputError("--calibrate writes a directory in the toolkit's own layout; give another OUT")
