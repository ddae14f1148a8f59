"""Primitives, deformations and the model."""

from __future__ import annotations

from dataclasses import replace
from unittest import mock

import pytest
import torch

from swiftwrf import AngularGrid, FitConfig, InputError, ModelConfig, SwiftWRF, fit, load
from swiftwrf.data.store import Store
from swiftwrf.gp import Kernel
from swiftwrf.models.base import bounding_box, make_model
from swiftwrf.models.swiftwrf.deformation.base import COMPONENTS
from swiftwrf.models.swiftwrf.deformation.per_primitive_mlp import PerPrimitiveMLP
from swiftwrf.models.swiftwrf.field import DeformableGaussians
from swiftwrf.models.swiftwrf.loss import spectrum_loss
from swiftwrf.models.swiftwrf.mlp import encode
from swiftwrf.models.swiftwrf.primitives import MIN_WIDTH_PIXELS, Primitives

GRID = AngularGrid.hemisphere(15, 60)
KERNEL = Kernel(long=1.0, short=0.3, share=0.6, noise=1e-2)


def field(seed=0, **changes):
    generator = torch.Generator().manual_seed(seed)
    anchor = torch.rand(9, 3, generator=generator, dtype=torch.float64) * 2 + 5
    config = ModelConfig(**{"n_primitives": 6, "rank": 4, **changes})
    return DeformableGaussians.initial(config, GRID, anchor, KERNEL, generator=generator), anchor


def model(**changes):
    """A model with random parameters, as after a fit."""
    gaussians, anchor = field(**changes)
    shake(gaussians)
    wrf = SwiftWRF()
    wrf.grid, wrf.bounds = GRID, bounding_box(anchor)
    wrf._take(gaussians)
    return wrf, anchor


def shake(module, seed=1, size=0.2):
    """Random parameters, so that nothing is at its special start."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter += size * torch.randn(parameter.shape, generator=generator)


def test_constraints_hold_for_any_parameters(generator):
    primitives = Primitives(50, GRID, bounded=True, generator=generator)
    with torch.no_grad():
        for parameter in primitives.parameters():
            parameter.normal_(std=20, generator=generator)
    mean, cholesky, attenuation, _ = primitives()
    assert (cholesky[:, 0] >= MIN_WIDTH_PIXELS * GRID.azimuth_step).all()
    assert (cholesky[:, 2] >= MIN_WIDTH_PIXELS * GRID.elevation_step).all()
    assert ((attenuation >= 0) & (attenuation <= 1)).all()
    assert ((mean >= 0) & (mean <= torch.tensor([2 * torch.pi, torch.pi / 2]) + 1e-6)).all()


def test_encoding_is_that_of_the_paper():
    encoded = encode(torch.tensor([0.25]), 2)
    assert encoded.tolist() == pytest.approx([0.25, 0.5**0.5, 1.0, 0.5**0.5, 0.0], abs=1e-6)


def test_paper_network_has_the_papers_size_and_starts_at_rest(generator):
    network = PerPrimitiveMLP(("mean", "response", "attenuation"), generator=generator)
    assert len(network.layers) == 8
    assert network.layers[0].in_features == 2 * 21 + 3 * 13
    assert network.layers[2].in_features == 156 + 81
    offsets = network(torch.rand(3, 3), torch.rand(5, 2))
    assert offsets.mean.shape == (3, 5, 2)
    assert offsets.attenuation.shape == (3, 5)
    assert offsets.cholesky is None
    assert not offsets.mean.any()


def test_far_from_all_anchors_the_model_is_canonical():
    wrf, _ = model()
    far = wrf.synthesize(torch.tensor([[1e6, 0.0, 0.0]]))
    canonical = wrf.field(torch.zeros(1, 3), deform=False).detach().clamp(0, 1)
    torch.testing.assert_close(far, canonical, atol=1e-5, rtol=0)


@pytest.mark.parametrize("deformation", ["motion_basis", "per_primitive_mlp", "none"])
def test_gradients_reach_every_parameter(deformation):
    gaussians, anchor = field(deformation=deformation, components=tuple(COMPONENTS))
    shake(gaussians, size=0.02)
    gaussians(gaussians.normalise(anchor)).square().sum().backward()
    for name, parameter in gaussians.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


def test_stopped_means_get_no_gradient():
    gaussians, anchor = field()
    gaussians(gaussians.normalise(anchor), stop_mean=True).sum().backward()
    assert gaussians.primitives.mean.grad is None


@pytest.mark.parametrize("components", [("response",), ("mean", "response")])
def test_predict_gives_gradients_by_parameters_only_on_request(components):
    wrf, anchor = model(components=components)
    assert not wrf.predict(anchor).mean.requires_grad
    expected = wrf.synthesize(anchor)
    wrf.field.requires_grad_(True)
    mean = wrf.predict(anchor).mean
    torch.testing.assert_close(mean.detach(), expected, atol=1e-5, rtol=0)
    mean.sum().backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in wrf.parameters())


@pytest.mark.parametrize("grid", [None, AngularGrid.hemisphere(7, 30)])
def test_a_cached_grid_follows_its_parameters(room, grid):
    wrf = fit(room, FitConfig(model=ModelConfig(n_primitives=16, rank=4)))

    def prediction():
        found = wrf.predict(room.position[:3], grid)
        return torch.stack([found.mean, found.std])

    first = prediction()
    assert torch.equal(prediction(), first)
    with torch.no_grad():
        wrf.field.primitives.mean += 0.3
    second = prediction()
    assert (second[0] - first[0]).abs().max() > 0.01
    assert (second[1] - first[1]).abs().max() > 1e-4
    wrf._cache.clear()
    assert torch.equal(prediction(), second)
    assert sum(tensor.numel() for tensor in wrf._cache.values()) == (16 + 1) * 7 * 30 if grid else 17 * 15 * 60


def test_the_cache_is_bounded(room, monkeypatch):
    wrf = fit(room, FitConfig(model=ModelConfig(n_primitives=16, rank=4)))
    monkeypatch.setattr("swiftwrf.models.swiftwrf.model.MAX_CACHED_VALUES", 40_000)
    for azimuths in (30, 40, 50, 60, 100, 200):
        grid = AngularGrid.hemisphere(15, azimuths)
        drawn = wrf.synthesize(room.position[:2], grid)
        assert sum(tensor.numel() for tensor in wrf._cache.values()) <= 40_000
        apart = wrf.field.render(wrf.field.gaussians(wrf.field.normalise(room.position[:2])), 2, grid)
        torch.testing.assert_close(drawn, apart.clamp(0, 1), atol=2e-5, rtol=0)


def test_any_resolution_and_batches_alike():
    wrf, anchor = model()
    fine = wrf.synthesize(anchor, grid=AngularGrid.hemisphere(45, 180))
    assert fine.shape == (9, 45, 180)
    wrf.batch = 2
    torch.testing.assert_close(fine[:, 2::3, ::3], wrf.synthesize(anchor), atol=1e-4, rtol=0)


@pytest.mark.parametrize("deformation", ["motion_basis", "per_primitive_mlp", "none"])
def test_a_saved_model_predicts_the_same_bits(tmp_path, deformation):
    wrf, anchor = model(deformation=deformation)
    wrf.save(tmp_path / "model.safetensors", {"commit": "abc"})
    again = load(tmp_path / "model.safetensors")
    assert torch.equal(again.synthesize(anchor + 0.01), wrf.synthesize(anchor + 0.01))
    assert again.config == wrf.config
    assert again.field.config == wrf.field.config


def test_a_scene_of_one_spectrum_is_saved_and_loaded(room, tmp_path):
    """Its spectra have no principal components, so that nothing deforms."""
    still = replace(room, store=Store(room.spectrum[:1].expand(40, -1, -1).clone()))
    wrf = fit(still, FitConfig(model=ModelConfig(n_primitives=16)))
    wrf.save(tmp_path / "model")
    assert torch.equal(load(tmp_path / "model").synthesize(room.position), wrf.synthesize(room.position))


def test_load_refuses_other_files(tmp_path):
    from swiftwrf.runtime import checkpoint

    with pytest.raises(InputError, match="not a readable"):
        load(tmp_path / "nothing")
    (tmp_path / "text").write_text("hello")
    with pytest.raises(InputError, match="not a readable"):
        load(tmp_path / "text")
    checkpoint.write(tmp_path / "other", "fit state", {"a": torch.zeros(1)}, {})
    with pytest.raises(InputError, match="holds 'fit state' in format 1; expected '"):
        load(tmp_path / "other")


def test_positions_in_kilometres_keep_their_millimetres():
    near = torch.rand(9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    config = ModelConfig(n_primitives=3, rank=4)
    a, b = (
        DeformableGaussians.initial(config, GRID, at, KERNEL, generator=torch.Generator().manual_seed(0))
        for at in (near, near + 5e5)
    )
    torch.testing.assert_close(a.normalise(near), b.normalise(near + 5e5), atol=1e-6, rtol=0)


def test_products_of_kernels_are_the_rasterized_spectra(room):
    wrf = fit(room, FitConfig(model=ModelConfig(n_primitives=32)))
    with torch.no_grad():
        wrf.field.primitives.response[:, 1] = 0.1  # an imaginary part, too
    x = wrf.field.normalise(room.position)
    for grid in (room.grid, AngularGrid.hemisphere(30, 120)):
        rasterized = wrf.field.render(wrf.field.gaussians(x), len(x), grid).clamp(0, 1)
        torch.testing.assert_close(wrf.synthesize(room.position, grid), rasterized, atol=2e-5, rtol=0)
        one = torch.cat([wrf.synthesize(position[None], grid) for position in room.position])
        torch.testing.assert_close(one, rasterized, atol=2e-5, rtol=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixel_loss": "L1"}, "pixel_loss must be 'l1' or 'l2'"),
        ({"validation": "blok"}, "validation must be"),
        ({"steps": -5}, "steps must be a whole number at least 0"),
        ({"batch": 0}, "batch must be a whole number at least 1"),
        ({"rate": -1}, "rate must be a number above 0"),
        ({"ssim_weight": 2}, "ssim_weight must be"),
        ({"model": 3}, "model must be an instance of ModelConfig"),
        ({"preset": "Paper"}, "preset must be 'quick' or 'paper'"),
        ({"presets": "paper"}, "no option 'presets'"),
    ],
)
def test_options_outside_their_ranges_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        SwiftWRF(**changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"n_primitives": -1},
        {"n_primitives": 0},
        {"n_primitives": 2.5},
        {"rank": -1},
        {"cutoff": 1},
        {"components": ("response", "response")},
        {"components": ("means",)},
        {"deformation": "other"},
    ],
)
def test_structures_that_cannot_be_are_refused(changes):
    with pytest.raises(InputError, match=r"must be|unknown deformation"):
        ModelConfig(**changes)


def test_the_loss_refuses_unknown_names():
    with pytest.raises(InputError, match="pixel_loss must be 'l1' or 'l2'"):
        spectrum_loss(torch.zeros(1, 9, 9), torch.zeros(1, 9, 9), pixel_loss="L1")


def test_the_paper_preset_has_the_papers_settings_and_given_options():
    wrf = make_model("swiftwrf", preset="paper", seed=1, validation="block")
    assert wrf.config == FitConfig.paper(seed=1, validation="block")
    assert SwiftWRF(preset="paper", batch=4).config == FitConfig.paper(batch=4)
    with pytest.raises(InputError, match="takes a FitConfig"):
        SwiftWRF(ModelConfig())


@pytest.mark.parametrize(("n_primitives", "batch"), [(16, 4096), (10_000, 1677), (500_000, 64)])
def test_a_gpu_evaluates_more_positions_at_a_time_within_its_memory(n_primitives, batch):
    model = SwiftWRF()
    model.field = mock.Mock(primitives=range(n_primitives))
    assert model._batch_on(torch.device("cpu")) == 64
    assert model._batch_on(torch.device("cuda")) == batch
