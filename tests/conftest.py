"""Shared fixtures: the toy scene, the measured data where they are, and the one table of tolerances."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from swiftwrf import Spectra, simulated_room

# Largest error of a fast maker against the float64 definition: values as a share of the sum of |weight|, gradients as
# relative L2. Float32 rounding sets the first row; the cutoff itself the second.
VALUE_TOLERANCE = {None: 5e-6, 1e-4: 3e-4}
GRADIENT_TOLERANCE = {None: 1e-5, 1e-4: 1e-5}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skips what this machine cannot run, with the reason."""
    for item in items:
        if "cuda" in item.keywords and not torch.cuda.is_available():
            item.add_marker(pytest.mark.skip(reason="needs an NVIDIA GPU"))
        if "data" in item.keywords and "SWIFTWRF_DATA" not in os.environ:
            item.add_marker(pytest.mark.skip(reason="needs the measured data: set SWIFTWRF_DATA to their folder"))


@pytest.fixture(scope="session")
def room() -> Spectra:
    """Forty spectra of the simulated room on a small grid."""
    from swiftwrf import AngularGrid

    return simulated_room(n=40, seed=0, grid=AngularGrid.hemisphere(15, 60))


@pytest.fixture(scope="session")
def measured_data() -> Path:
    """The folder of the measured data sets."""
    return Path(os.environ["SWIFTWRF_DATA"])


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)
