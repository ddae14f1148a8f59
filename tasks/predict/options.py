"""Options of python -m tasks.predict, and their checks."""

from __future__ import annotations

from typing import Annotated

import tyro

from tasks.options import Answered, Options, SpectraSource, TableSource, options


@options
class PredictConfig(Options):
    """Apply a saved model to new measurements or positions, and write a table.

    An estimator gives the directions of spectra, and a locator the positions of transmitters. A field model gives spectra,
    and an RSSI model powers, at the positions of a table.

    Example: swiftwrf predict runs/aoa/first DIR

    Example: swiftwrf predict runs/rssi/first/model.safetensors positions.csv --out predicted.csv
    """

    model: Annotated[str, tyro.conf.Positional]
    """file of a model, or directory of a run: then the estimator that cross-validation chose, the locator or the RSSI
    model"""
    source: Annotated[str, tyro.conf.Positional]
    """measurements of any format that tasks.aoa or tasks.rssi takes, RSSI without positions included; a .npy file (n,
    elevations, azimuths) of magnitudes in [0, 1]; or, for a field or RSSI model, a table of positions: x, y, z [m], or
    latitude, longitude, altitude"""
    track: float | None = None
    """rows of SOURCE are a walk: smooths its positions by this typical speed [m/s]. Rows without times are 1 s apart"""
    ignore_receivers: bool = False
    """leave out receivers in SOURCE that the locator does not have (default: refuse them)"""
    out: str | None = None
    """table to write; of a field or RSSI model also .mat; must not exist (default: a new predicted-TIME.csv)"""
    output: Answered = Answered()
    spectra: SpectraSource = SpectraSource()
    table: TableSource = TableSource()
