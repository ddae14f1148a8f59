"""Options of python -m tasks.estimate, and their checks."""

from __future__ import annotations

from typing import Annotated

import tyro

from tasks.options import SpectraSource, command_options


@command_options
class EstimateConfig(SpectraSource):
    """Directions from spectra, by an estimator that `python -m tasks.aoa` trained and left in its run's directory.

    Example: python -m tasks.estimate runs/aoa/first/aann_kernel-mix0.3.safetensors DIR
    """

    estimator: Annotated[str, tyro.conf.Positional]
    """file of the estimator, e.g. runs/aoa/first/aann_kernel-mix0.3.safetensors or matched_field-mix0.3.safetensors"""
    source: Annotated[str, tyro.conf.Positional]
    """measurements of any format that tasks.aoa takes, or spectra of unknown positions: a .npy file (n, elevations,
    azimuths) of magnitudes in [0, 1]"""
    out: str | None = None
    """table to write; must not exist (default: a new directions-TIME.csv)"""
