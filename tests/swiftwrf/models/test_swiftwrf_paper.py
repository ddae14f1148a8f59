"""The paper's model: primitives, network, fit by gradient descent."""

from dataclasses import replace

import pytest
import torch

from swiftwrf import AngularGrid, FitError, InputError, make_model
from swiftwrf.metrics import psnr
from swiftwrf.models.mlp import encode
from swiftwrf.models.primitives import MIN_WIDTH_PIXELS, Primitives
from swiftwrf.models.swiftwrf_paper import DeformableGaussians, Optimisation, SwiftWRFPaper, SwiftWRFPaperConfig
from swiftwrf.positions import centre_and_half_side
from swiftwrf.rasterize import rasterize_magnitude
from swiftwrf.runtime.checkpoint import read, write

GRID = AngularGrid.hemisphere(15, 60)
QUICK = SwiftWRFPaperConfig(n_primitives=24, steps=80, check_every=20)
TINY = SwiftWRFPaperConfig(n_primitives=4, steps=10, check_every=5)


def field(n=6, shift=0.0):
    """Return random Gaussians whose network does not rest, and positions of their scene."""
    generator = torch.Generator().manual_seed(0)
    position = torch.rand(9, 3, generator=generator, dtype=torch.float64) * 2 + 5 + shift
    gaussians = DeformableGaussians(n, GRID, *centre_and_half_side(position), generator=generator)
    for parameter in gaussians.output.parameters():
        torch.nn.init.normal_(parameter, std=0.05, generator=generator)
    return gaussians, position


def rendered(gaussians, position, **options):
    return rasterize_magnitude(*gaussians(gaussians.normalise(position), **options), GRID)


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


def test_the_network_has_the_papers_size_and_starts_at_rest(generator):
    position = torch.rand(3, 3, generator=generator, dtype=torch.float64)
    gaussians = DeformableGaussians(5, GRID, *centre_and_half_side(position), generator=generator)
    assert [layer.in_features for layer in gaussians.layers] == [81, 156, 237, 156, 237, 156, 237, 156]
    assert gaussians.output.out_features == 5
    for deformed, canonical in zip(*(gaussians(position.float(), deform=d) for d in (True, False)), strict=True):
        assert torch.equal(deformed, canonical)


def test_gradients_reach_every_parameter_but_the_means_of_the_fine_stage():
    gaussians, position = field()
    rendered(gaussians, position).square().sum().backward()
    for name, parameter in gaussians.named_parameters():
        if name == "primitives.mean":
            assert parameter.grad is None
        else:
            assert parameter.grad.abs().sum() > 0, name
    rendered(gaussians, position, deform=False).square().sum().backward()
    assert gaussians.primitives.mean.grad.abs().sum() > 0


def test_gradcheck_of_the_network():
    gaussians, position = field(n=3)
    gaussians, x = gaussians.double(), gaussians.normalise(position[:2]).double()
    values = [torch.randn(shape, dtype=torch.float64, requires_grad=True) for shape in ((5, 156), (5,))]

    def deformed(weight, bias):
        parameters = {"output.weight": weight, "output.bias": bias}
        mean, _, product = torch.func.functional_call(gaussians, parameters, (x,))
        return mean, product

    assert torch.autograd.gradcheck(deformed, values)


def test_the_preset_paper_is_the_paper():
    model = make_model("swiftwrf", preset="paper", seed=1, validation="block")
    assert isinstance(model, SwiftWRFPaper)
    assert model.config == SwiftWRFPaperConfig.paper(seed=1, validation="block")
    assert SwiftWRFPaper(preset="paper", batch=4).config == SwiftWRFPaperConfig.paper(batch=4)
    paper = model.config
    assert (paper.n_primitives, paper.steps, paper.batch, paper.max_azimuths) == (10_000, 110_000, 1, 0)
    assert (paper.rate, paper.deformation_rate, paper.ssim_weight, paper.smoothing) == (1e-2, 8e-3, 0.3, 1.0)


def test_smoothing_is_annealed(room):
    optimisation = Optimisation(replace(QUICK, steps=200, smoothing_steps=100), room, "cpu")
    for fine_step, fraction in ((0, 1), (50, 0.5), (101, 0)):
        optimisation.step = optimisation.coarse_steps + fine_step
        assert optimisation.smoothing() == pytest.approx(fraction * 2 / len(room) ** (1 / 3))


def test_loss_that_is_not_finite_stops_and_keeps_the_last_good_state(room, tmp_path, monkeypatch):
    state = tmp_path / "state"
    honest = Optimisation.objective

    def breaks(self):
        return honest(self) * (float("nan") if self.step == 50 else 1)

    monkeypatch.setattr(Optimisation, "objective", breaks)
    with pytest.raises(FitError, match="step 50"):
        SwiftWRFPaper(QUICK).fit(room, checkpoint=state)
    monkeypatch.undo()
    records = []
    SwiftWRFPaper(QUICK).fit(room, checkpoint=state, on_record=records.append)
    assert [record["step"] for record in records][:3] == [20, 40, 60]  # went on from the state at 40
    assert records[1]["elapsed"] < records[2]["elapsed"]


def test_a_fit_that_ended_worse_is_refused_again(room, tmp_path, monkeypatch):
    """Its state is kept, and the same call must not take it for a result."""
    honest = Optimisation.record

    def record(self, loss):
        self.first_loss = -1.0  # better than any loss
        return honest(self, loss)

    monkeypatch.setattr(Optimisation, "record", record)
    for _ in range(2):
        with pytest.raises(FitError, match="worse than the -1 it began with"):
            SwiftWRFPaper(QUICK, steps=20).fit(room, checkpoint=tmp_path / "state")


def test_recovers_a_scene_that_it_can_represent_exactly(room, generator):
    """A fit of spectra of known primitives and network that starts beside the truth returns to it."""
    gaussians, position = field(n=4)
    with torch.no_grad():
        gaussians.primitives.response.mul_(3)
        scene = replace(room.subset(torch.arange(9)), position=position)
        scene = replace(scene, store=type(scene.store)(rendered(gaussians, position).clamp(0, 1)))
    config = SwiftWRFPaperConfig(n_primitives=4, steps=300, rate=3e-3, deformation_rate=1e-3, coarse_fraction=0.0)
    optimisation = Optimisation(replace(config, batch=9, smoothing=0.0, ssim_weight=0.0), scene, "cpu")
    start = gaussians.state_dict()
    for name in ("primitives.cholesky", "primitives.response", "output.weight", "output.bias"):
        start[name] = start[name] + 0.02 * torch.randn(start[name].shape, generator=generator)
    for module in (optimisation.model, optimisation.average.module):
        module.load_state_dict(start)

    def quality(module):
        return float(psnr(rendered(module, position).detach(), scene.spectrum).median())

    before = quality(optimisation.model)
    while optimisation.step < 300:
        optimisation.advance()
    assert before < 35 < 45 < quality(optimisation.result)


def test_a_damaged_state_of_a_fit_is_refused(room, tmp_path):
    state = tmp_path / "state"
    SwiftWRFPaper(TINY).fit(room, checkpoint=state)
    kind, tensors, header = read(state, "fit state")
    for change in ({"seconds": None}, {"records": 3}, {"step": "x"}, {"fingerprint": 1}):
        write(state, kind, tensors, header | change)
        with pytest.raises(InputError):
            SwiftWRFPaper(TINY).fit(room, checkpoint=state)
    write(state, kind, {name: t for name, t in tensors.items() if "mean" not in name}, header)
    with pytest.raises(InputError):
        SwiftWRFPaper(TINY).fit(room, checkpoint=state)
