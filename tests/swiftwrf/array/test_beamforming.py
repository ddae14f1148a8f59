"""Beamformers against their definitions, written out."""

import math

import pytest
import torch

from swiftwrf import AngularGrid
from swiftwrf.array.beamforming import BEAMFORMERS, DIAGONAL_LOADING
from swiftwrf.array.planar import PlanarArray

ARRAY = PlanarArray.grid(2, 3, 0.06, 2.4e9)
GRID = AngularGrid.hemisphere(6, 24)


def steering():
    phase = ARRAY.phase(GRID.direction).flatten(0, 1)
    return torch.polar(torch.ones_like(phase), phase)


def channels(n=4, count=9, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(n, count, 6, dtype=torch.complex128, generator=generator)


def slow(name, channel):
    """Squared spectrum (directions,) of one position (S, K)."""
    heard = channel / channel.abs() if name == "phase" else channel
    covariance = sum(torch.outer(h, h.conj()) for h in heard) / len(heard)
    share = []
    for a in steering():
        if name == "capon":
            loaded = covariance * len(a) / covariance.trace() + DIAGONAL_LOADING * torch.eye(len(a))
            share.append(1 / (a.conj() @ torch.linalg.solve(loaded, a)).real)
        else:
            share.append((a.conj() @ covariance @ a).real / (len(a) * covariance.trace().real))
    power = torch.stack(share)
    return power / power.max() if name == "capon" else power


COUNTS = [(name, count) for name in BEAMFORMERS for count in (1, 6, 9) if name != "capon" or count > 1]


@pytest.mark.parametrize(("name", "count"), COUNTS)
def test_beamformers_are_their_definitions(name, count):
    """Phases of one snapshot give the equation of the paper."""
    channel = channels(count=count)
    spectrum = ARRAY.spectrum(channel, GRID, name)
    expected = torch.stack([slow(name, one) for one in channel]).sqrt().reshape(-1, *GRID.shape)
    torch.testing.assert_close(spectrum, expected.float(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["phase", "bartlett"])
def test_one_path_fills_the_beam_towards_it(name):
    direction = GRID.direction[2, 5]
    phase = ARRAY.phase(direction)
    channel = (3.0 * torch.polar(torch.ones_like(phase), phase)).expand(1, 4, 6)
    spectrum = ARRAY.spectrum(channel, GRID, name)[0]
    assert spectrum[2, 5].item() == pytest.approx(1, abs=1e-5)
    assert spectrum.argmax().item() == 2 * 24 + 5


def test_capon_separates_what_bartlett_merges():
    grid = AngularGrid.hemisphere(45, 180)
    array = PlanarArray.grid(4, 4, 0.0625, 2.4e9)
    generator = torch.Generator().manual_seed(0)
    sources = grid.direction[30, [0, 40]]  # 28 degrees of arc apart
    signal = torch.randn(200, 2, dtype=torch.complex128, generator=generator)
    response = torch.polar(torch.ones(2, 16, dtype=torch.float64), array.phase(sources))
    noise = 0.05 * torch.randn(200, 16, dtype=torch.complex128, generator=generator)
    channel = (signal @ response + noise)[None]
    depth = {}
    for name in ("bartlett", "capon"):
        row = array.spectrum(channel, grid, name)[0, 30]
        depth[name] = float(row[20] / row[[0, 40]].min())
    assert depth["capon"] < 0.5 < depth["bartlett"]


def test_phases_of_near_sources_are_those_of_their_distances():
    array = PlanarArray.square(4, 2.4e9)
    source = torch.tensor([[0.3, 0.2, 0.5], [-1.0, 2.0, 4.0]], dtype=torch.float64)
    element = torch.nn.functional.pad(array.element, (0, 1))
    exact = math.tau / array.wavelength * (source.norm(dim=1, keepdim=True) - (source[:, None] - element).norm(dim=2))
    torch.testing.assert_close(array.phase_at(source), exact)
    far = torch.nn.functional.normalize(source, dim=1)
    torch.testing.assert_close(array.phase_at(1e7 * far), array.phase(far), atol=1e-6, rtol=0)
