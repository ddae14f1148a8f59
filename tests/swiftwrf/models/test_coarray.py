"""The co-array: exact space, projection, model."""

from dataclasses import replace

import pytest
import torch

from swiftwrf import AngularGrid, CoarrayModel, InputError, load_spectra
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.store import Store
from swiftwrf.metrics import psnr, ssim
from swiftwrf.models.coarray import basis, differences, project

GRID = AngularGrid.hemisphere(15, 60)


def spectra(array, n=5, grid=GRID):
    """Return spectra of random channels."""
    generator = torch.Generator().manual_seed(0)
    channel = torch.randn(n, len(array.element), 2, dtype=torch.float64, generator=generator)
    return array.spectrum(torch.view_as_complex(channel), grid)


@pytest.mark.parametrize(
    ("array", "size"),
    [
        (PlanarArray.square(4, 3e9), 49),
        (PlanarArray.square(2, 3e9, spacing=0.03), 9),
        (PlanarArray(torch.tensor([[0.0, 0.0], [0.05, 0.0], [0.0, 0.04]], dtype=torch.float64), 0.1), 7),  # an L
        (
            PlanarArray(0.05 * torch.arange(5, dtype=torch.float64)[:, None] * torch.tensor([[1.0, 0.0]]), 0.1),
            9,
        ),  # a line
    ],
)
def test_squared_spectra_lie_in_the_space_of_the_co_array(array, size):
    functions, power = basis(array, GRID), spectra(array).double().square().flatten(1)
    assert len(functions) == size == 1 + 2 * len(differences(array))
    missed = power - power @ torch.linalg.pinv(functions) @ functions
    assert float(missed.norm() / power.norm()) < 1e-6


def test_projection_leaves_what_the_array_produces_and_removes_what_it_cannot():
    array = PlanarArray.square(4, 3e9)
    exact = spectra(array)
    torch.testing.assert_close(project(exact, array, GRID), exact, atol=1e-3, rtol=0)  # near 0 roots magnify rounding
    noise = 0.1 * torch.randn(exact.shape, generator=torch.Generator().manual_seed(1))
    noisy = (exact + noise).clamp(0, 1)
    assert float((project(noisy, array, GRID) - exact).square().mean()) < 0.3 * float((noisy - exact).square().mean())


def test_projection_finds_what_stretching_took():
    array = PlanarArray.square(4, 3e9)
    exact = spectra(array)
    low, high = exact.amin(dim=(1, 2), keepdim=True) + 0.05, exact.amax(dim=(1, 2), keepdim=True)
    stretched = (exact - low) / (high - low)  # negative where it was below, as no image can be: still in the space
    torch.testing.assert_close(
        project(stretched, array, GRID, stretched=True), stretched.clamp(0, 1), atol=2e-3, rtol=0
    )
    assert float((project(stretched, array, GRID) - stretched.clamp(0, 1)).abs().max()) > 2e-2


def test_projection_refuses_other_grids():
    with pytest.raises(InputError, match=r"shape \(n, 15, 60\), got \(5, 60, 15\)"):
        project(torch.zeros(5, 60, 15), PlanarArray.square(4, 3e9), GRID)


def test_model_draws_any_resolution_what_the_array_would(room):
    """Twice as fine, every second pixel is the same one."""
    model = CoarrayModel().fit(room)
    fine = AngularGrid.hemisphere(30, 120)
    a, b = model.synthesize(room.position[:3]), model.synthesize(room.position[:3], fine)
    torch.testing.assert_close(b[:, 1::2, ::2], a, atol=1e-4, rtol=0)


def test_equal_arrays_are_equal_and_share_their_basis():
    one, two = PlanarArray.square(4, 1e9), PlanarArray.square(4, 1e9)
    assert one == two
    assert one != PlanarArray.square(4, 2e9)
    assert basis(one, GRID) is basis(two, GRID)


def test_a_spectrum_without_any_signal_spoils_nothing(room):
    spectrum = room.spectrum.clone()
    spectrum[3] = 0
    model = CoarrayModel().fit(replace(room, store=Store(spectrum)))
    assert psnr(model.synthesize(room.position[4:]), spectrum[4:]).median() > 15


@pytest.mark.data
def test_measured_spectra_are_nearly_in_the_space(measured_data):
    """s23: 4 x 4 elements 0.16 m apart at 915 MHz, every image stretched by itself."""
    data = load_spectra(measured_data / "s23-200")
    projected = project(data.spectrum, PlanarArray.square(4, 915e6, spacing=0.16), data.grid, stretched=True)
    assert float(ssim(projected, data.spectrum).median()) > 0.98
