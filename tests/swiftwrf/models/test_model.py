"""SwiftWRF after its fit, and the co-array: exact space, projection, model."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from safetensors.torch import save_file

from swiftwrf import AngularGrid, InputError, SwiftWRF, fit, load, load_spectra
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.store import Store
from swiftwrf.metrics import psnr, ssim
from swiftwrf.models import coarray
from swiftwrf.models import swiftwrf as module
from swiftwrf.models.coarray import CoarrayModel, basis, differences
from swiftwrf.rasterize import rasterize_magnitude
from swiftwrf.runtime import checkpoint
from swiftwrf.testing import check_saved


@pytest.fixture(scope="module")
def fitted(room):
    return fit(room, n_primitives=32)


@pytest.fixture
def model(fitted):
    """A model that a test may change."""
    return deepcopy(fitted)


def test_far_from_all_training_positions_the_spectrum_is_their_mean(room, model):
    far = model.synthesize(torch.tensor([[1e6, 0.0, 0.0]]))
    weight = torch.stack([model.weight[:1], torch.zeros_like(model.weight[:1])], dim=-1)
    mean = rasterize_magnitude(model.mean[None], model.cholesky, weight, room.grid).clamp(0, 1)
    torch.testing.assert_close(far, mean, atol=2e-5, rtol=0)
    assert (mean - room.spectrum.mean(dim=0)).abs().mean() < 0.02


@pytest.mark.parametrize("grid", [None, AngularGrid.hemisphere(30, 120)])
def test_products_of_kernels_are_the_rasterized_spectra(room, model, grid):
    rasterized = rasterize_magnitude(*model.primitives(room.position), grid or room.grid).clamp(0, 1)
    torch.testing.assert_close(model.synthesize(room.position, grid), rasterized, atol=2e-5, rtol=0)
    model.batch = 7
    torch.testing.assert_close(model.synthesize(room.position, grid), rasterized, atol=2e-5, rtol=0)


def test_predict_gives_gradients_by_parameters_only_on_request(room, model):
    expected = model.predict(room.position).mean
    assert not expected.requires_grad
    for parameter in model.parameters():
        parameter.requires_grad_()
    found = model.predict(room.position)
    torch.testing.assert_close(found.mean.detach(), expected, atol=1e-5, rtol=0)
    found.mean.sum().backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in model.parameters())


def test_a_cached_grid_serves_gradients_by_positions(room, model):
    with torch.inference_mode():
        expected = model.predict(room.position).mean
    position = room.position.clone().requires_grad_()
    found = model.predict(position)
    torch.testing.assert_close(found.mean.detach(), expected.clone(), atol=1e-6, rtol=0)
    (found.mean.sum() + found.std.sum()).backward()
    assert position.grad.abs().sum() > 0


def test_the_cache_is_bounded(room, model, monkeypatch):
    monkeypatch.setattr(module, "MAX_CACHED_VALUES", 32 * 15 * 60)
    for azimuths in (30, 40, 50, 60, 100, 200):
        grid = AngularGrid.hemisphere(15, azimuths)
        found = model.predict(room.position[:2], grid)
        rasterized = rasterize_magnitude(*model.primitives(room.position[:2]), grid).clamp(0, 1)
        torch.testing.assert_close(found.mean, rasterized, atol=2e-5, rtol=0)
        assert found.std.shape == found.mean.shape
    assert [grid.n_azimuth for grid in model._cache] == [50, 60]


def test_a_scene_of_one_spectrum_is_saved_and_loaded(room):
    """Its spectra have no principal components, so that nothing depends on the position."""
    still = replace(room, store=Store(room.spectrum[:1].expand(40, -1, -1).clone()))
    model = fit(still, n_primitives=16)
    check_saved(model, lambda loaded: loaded.synthesize(room.position))


def test_load_refuses_other_files(tmp_path):
    with pytest.raises(InputError, match="not a readable"):
        load(tmp_path / "nothing")
    (tmp_path / "text").write_text("hello")
    with pytest.raises(InputError, match="not a readable"):
        load(tmp_path / "text")
    for header in ("", "[]", "{", "[" * 100_000, "3"):
        save_file({}, tmp_path / "m", {"kind": "swiftwrf model", "format": str(checkpoint.FORMAT), "header": header})
        with pytest.raises(InputError):
            load(tmp_path / "m")
    checkpoint.write(tmp_path / "other", "fit state", {"a": torch.zeros(1)}, {})
    with pytest.raises(InputError, match="holds 'fit state' in format 2; expected '"):
        load(tmp_path / "other")


@pytest.mark.parametrize(("n_primitives", "batch"), [(16, 4096), (10_000, 1677), (500_000, 64)])
def test_a_gpu_evaluates_more_positions_at_a_time_within_its_memory(n_primitives, batch):
    model = SwiftWRF()
    model.mean = torch.zeros(n_primitives, 2)
    assert model._batch_on(torch.device("cpu")) == 64
    assert model._batch_on(torch.device("cuda")) == batch


# the co-array


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


def offsets(flat, array, grid):
    """Return the offsets (n, 1) that stretching took from spectra (n, pixels), and the nearest spectra of the array."""
    functions, inverse = basis(array, grid), torch.linalg.pinv(basis(array, grid))
    offset = coarray._offset(flat, functions, inverse)
    return offset, ((flat + offset).square() @ inverse @ functions).clamp_min(0).sqrt() - offset


def test_what_stretching_took_is_found():
    array = PlanarArray.square(4, 3e9)
    exact = spectra(array).double().flatten(1)
    low, high = exact.amin(dim=1, keepdim=True) + 0.05, exact.amax(dim=1, keepdim=True)
    stretched = (exact - low) / (high - low)  # negative where it was below, as no image can be: still in the space
    offset, projected = offsets(stretched, array, GRID)
    torch.testing.assert_close(offset, low / (high - low), atol=2e-3, rtol=0)
    torch.testing.assert_close(projected, stretched, atol=2e-3, rtol=0)


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


def test_models_whose_parameters_overflow_are_refused(room):
    tensors, header = CoarrayModel().fit(room).state()
    model = CoarrayModel.from_state(tensors | {"form": 3e38 * tensors["form"].sign()}, header)
    with pytest.raises(InputError, match="not finite"):
        model.synthesize(room.position[:1])


@pytest.mark.data
def test_measured_spectra_are_nearly_in_the_space(measured_data):
    """s23: 4 x 4 elements 0.16 m apart at 915 MHz, every image stretched by itself."""
    data = load_spectra(measured_data / "s23-200")
    array, flat = PlanarArray.square(4, 915e6, spacing=0.16), data.spectrum.double().flatten(1)
    projected = offsets(flat, array, data.grid)[1].clamp(0, 1).float().reshape(data.spectrum.shape)
    assert float(ssim(projected, data.spectrum).median()) > 0.98
