"""What several tests build on: toy scenes, and the measured data where they are."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest
import torch

from swiftwrf import AngularGrid, Spectra, simulated_room
from swiftwrf.primitives import FLOOR

GRID = AngularGrid.hemisphere(30, 120)


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
    return simulated_room(n=40, seed=0, grid=AngularGrid.hemisphere(15, 60))


@pytest.fixture(scope="session")
def measured_data() -> Path:
    """The folder of the measured data sets."""
    return Path(os.environ["SWIFTWRF_DATA"])


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def scene(n=40, batch=3, seed=0, per_position=False, dtype=torch.float32, grid=GRID):
    """Random primitives from the width's floor to a radian, sheared, means beyond both edges and turns away."""
    generator = torch.Generator().manual_seed(seed)
    mean = torch.rand(batch, n, 2, generator=generator) * torch.tensor([6 * math.pi, 2.2]) - torch.tensor(
        [2 * math.pi, 0.3]
    )
    shape = (batch, n, 3) if per_position else (n, 3)
    floor = FLOOR * torch.tensor([grid.azimuth_step, 0.0, grid.elevation_step])
    cholesky = torch.exp(torch.rand(shape, generator=generator) * 4 - 4) + floor
    cholesky[..., 1] *= torch.randn(shape[:-1], generator=generator)
    weight = torch.randn(batch, n, 2, generator=generator)
    return [x.to(dtype).requires_grad_() for x in (mean, cholesky, weight)]
