"""Directions from spectra, by an estimator that a run of tasks.aoa trained."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from torch import Tensor

from swiftwrf import InputError, Spectra, load
from swiftwrf.data import read_spectra
from swiftwrf.data.store import Store
from swiftwrf.locate import MatchedField
from swiftwrf.metrics import angle_errors
from tasks.aoa.estimators import SavedEstimator
from tasks.records import write_table
from tasks.source import SpectraSource, reading


@dataclass(frozen=True)
class EstimateConfig(SpectraSource):
    """Directions from spectra, by an estimator that `python -m tasks.aoa` trained and left in its run's directory."""

    estimator: Annotated[str, tyro.conf.Positional]
    """file of the estimator, e.g. runs/aoa/first/aann-mix0.3.safetensors or matched_field-mix0.3.safetensors"""
    source: Annotated[str, tyro.conf.Positional]
    """measurements of any format that tasks.aoa takes, or spectra of unknown positions: a .npy file (n, elevations,
    azimuths) of magnitudes in [0, 1]"""
    out: str = "directions.csv"
    """table to write; must not exist"""


def run(config: EstimateConfig) -> None:
    """Writes a row a spectrum: azimuth and elevation [deg] and, where positions are known, the truth and the error.

    Raises:
        InputError: no such estimator, spectra that cannot be read or are not like those it was trained on, or `out` exists.
    """
    out = Path(config.out)
    if out.exists():
        raise InputError(f"--out {out} exists already and is never overwritten; choose another")
    if not out.parent.is_dir():
        raise InputError(f"--out {out} lies in {out.parent}, which is no directory")
    estimator = load(config.estimator)
    if not isinstance(estimator, SavedEstimator | MatchedField):
        raise InputError(f"{config.estimator} holds a {estimator.kind}; give an estimator that tasks.aoa trained")
    how, known = reading(config), None
    if not config.source.endswith(".npy"):
        known = read_spectra(config.source, how)
    elif how.given:
        raise InputError(f"{config.source} holds spectra as they are; --{how.given[0]} does not apply")
    store = Store(_read_array(Path(config.source))) if known is None else known.store
    _check_like(estimator, store, known, config.source)
    estimate = torch.cat([estimator.predict(part) for part in store.batches()])
    columns = {"azimuth_deg": estimate[:, 0].rad2deg(), "elevation_deg": estimate[:, 1].rad2deg()}
    if known is not None:
        truth = known.label.rad2deg()
        columns |= {"truth_azimuth_deg": truth[:, 0], "truth_elevation_deg": truth[:, 1]}
        columns["great_circle_deg"] = angle_errors(estimate, known.label)["great_circle"].rad2deg()
    index = torch.arange(len(store)) if known is None else known.index
    rows = zip(index.tolist(), *(column.tolist() for column in columns.values()), strict=True)
    write_table(out, [dict(zip(("index", *columns), row, strict=True)) for row in rows])
    error = f", median error {columns['great_circle_deg'].median():.2f} degrees" if known is not None else ""
    print(f"{len(store)} directions{error}: {out}")


def _read_array(file: Path) -> Tensor:
    """Spectra of unknown positions."""
    try:
        array = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{file} is not a readable .npy file ({error})") from None
    if not isinstance(array, np.ndarray) or array.ndim != 3 or array.dtype.kind != "f" or not len(array):
        raise InputError(f"{file} must hold floating-point spectra (n, elevations, azimuths)")
    spectrum = torch.from_numpy(np.array(array, dtype=np.float32))
    if not bool(((spectrum >= 0) & (spectrum <= 1)).all()):
        raise InputError(f"{file} must hold magnitudes in [0, 1]")
    return spectrum


def _check_like(estimator: SavedEstimator | MatchedField, store: Store, known: Spectra | None, source: str) -> None:
    """Refuses spectra on another grid than the estimator's."""
    own = estimator.grid
    if store.shape[1:] != own.shape or (known is not None and known.grid != own):
        shape, its = (" x ".join(map(str, s)) for s in (store.shape[1:], own.shape))
        raise InputError(
            f"{source} has spectra of {shape} directions, the estimator was trained on others ({its}); where spectra are "
            f"computed, --grid {' '.join(map(str, own.shape))} makes them alike"
        )
