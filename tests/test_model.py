"""Primitives, deformations and the model."""

from __future__ import annotations

import pytest
import torch

from swiftwrf import AngularGrid, FitConfig, InputError, ModelConfig, SwiftWRF, fit, load
from swiftwrf.gp import Kernel
from swiftwrf.models.swiftwrf.deformation.base import COMPONENTS
from swiftwrf.models.swiftwrf.deformation.per_primitive_mlp import PerPrimitiveMLP, encode
from swiftwrf.models.swiftwrf.primitives import FLOOR, Primitives

GRID = AngularGrid.hemisphere(15, 60)
KERNEL = Kernel(long=1.0, short=0.3, share=0.6, noise=1e-2)


def model(seed=0, **changes):
    generator = torch.Generator().manual_seed(seed)
    anchor = torch.rand(9, 3, generator=generator, dtype=torch.float64) * 2 + 5
    config = ModelConfig(**{"n_primitives": 6, "rank": 4, **changes})
    return SwiftWRF.make(config, GRID, anchor, KERNEL, generator=generator), anchor


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
    assert (cholesky[:, 0] >= FLOOR * GRID.azimuth_step).all()
    assert (cholesky[:, 2] >= FLOOR * GRID.elevation_step).all()
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
    shake(wrf)
    far = wrf.synthesize(torch.tensor([[1e6, 0.0, 0.0]]))
    canonical = wrf(torch.zeros(1, 3), deform=False).detach().clamp(0, 1)
    torch.testing.assert_close(far, canonical)


@pytest.mark.parametrize("deformation", ["motion_basis", "per_primitive_mlp", "none"])
def test_gradients_reach_every_parameter(deformation):
    wrf, anchor = model(deformation=deformation, components=tuple(COMPONENTS))
    shake(wrf, size=0.02)
    wrf(wrf.normalise(anchor)).square().sum().backward()
    for name, parameter in wrf.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


def test_stopped_means_get_no_gradient():
    wrf, anchor = model()
    wrf(wrf.normalise(anchor), stop_mean=True).sum().backward()
    assert wrf.primitives.mean.grad is None


def test_synthesize_gives_any_resolution_and_batches_alike():
    wrf, anchor = model()
    shake(wrf)
    fine = wrf.synthesize(anchor, grid=AngularGrid.hemisphere(45, 180))
    assert fine.shape == (9, 45, 180)
    torch.testing.assert_close(fine[:, 2::3, ::3], wrf.synthesize(anchor, batch=2), atol=1e-4, rtol=0)


def test_synthesize_refuses_what_is_no_position():
    wrf, _ = model()
    with pytest.raises(InputError, match="shape"):
        wrf.synthesize(torch.zeros(4, 2))
    with pytest.raises(InputError, match="finite"):
        wrf.synthesize(torch.tensor([[0.0, 0.0, float("inf")]]))


@pytest.mark.parametrize("deformation", ["motion_basis", "per_primitive_mlp", "none"])
def test_a_saved_model_synthesizes_the_same_bits(tmp_path, deformation):
    wrf, anchor = model(deformation=deformation)
    shake(wrf)
    wrf.save(tmp_path / "model.safetensors", {"commit": "abc"})
    again = load(tmp_path / "model.safetensors")
    assert torch.equal(again.synthesize(anchor + 0.01), wrf.synthesize(anchor + 0.01))
    assert again.config == wrf.config


def test_load_refuses_other_files(tmp_path):
    from swiftwrf.runtime import checkpoint

    with pytest.raises(InputError, match="not a readable"):
        load(tmp_path / "nothing")
    (tmp_path / "text").write_text("hello")
    with pytest.raises(InputError, match="not a readable"):
        load(tmp_path / "text")
    checkpoint.write(tmp_path / "other", "fit state", {"a": torch.zeros(1)}, {})
    with pytest.raises(InputError, match=r"expected .*'swiftwrf model'"):
        load(tmp_path / "other")


def test_positions_in_kilometres_keep_their_millimetres():
    generator = torch.Generator().manual_seed(0)
    near = torch.rand(9, 3, generator=generator, dtype=torch.float64)
    a = SwiftWRF.make(
        ModelConfig(n_primitives=3, rank=4), GRID, near, KERNEL, generator=torch.Generator().manual_seed(0)
    )
    b = SwiftWRF.make(
        ModelConfig(n_primitives=3, rank=4), GRID, near + 5e5, KERNEL, generator=torch.Generator().manual_seed(0)
    )
    torch.testing.assert_close(a.normalise(near), b.normalise(near + 5e5), atol=1e-6, rtol=0)


def test_many_spectra_of_fixed_primitives_are_those_drawn_one_by_one(room):
    model = fit(room, FitConfig(model=ModelConfig(n_primitives=32)), progress=False)
    with torch.no_grad():
        model.primitives.response[:, 1] = 0.1  # an imaginary part, too
    for grid in (room.grid, AngularGrid.hemisphere(30, 120)):
        together = model.synthesize(room.position, grid)
        apart = torch.cat([model.synthesize(position[None], grid) for position in room.position])
        torch.testing.assert_close(together, apart, atol=2e-5, rtol=0)
