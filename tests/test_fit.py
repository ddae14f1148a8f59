"""Fitting: what it reaches, what it refuses, how it goes on."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from swiftwrf import AngularGrid, FitConfig, FitError, InputError, ModelConfig, Spectra, SwiftWRF, fit
from swiftwrf.data.splits import folds
from swiftwrf.fitting.optimise import Optimisation
from swiftwrf.fitting.search import doubling_search
from swiftwrf.gp import Kernel, choose_kernel
from swiftwrf.metrics import psnr

QUICK = FitConfig(model=ModelConfig(n_primitives=24), steps=200, check_every=50)


def test_fit_beats_the_mean_spectrum(room):
    wrf = fit(room, replace(QUICK, steps=300), progress=False)
    fitted = psnr(wrf.synthesize(room.position), room.spectrum).median()
    mean = psnr(room.spectrum.mean(dim=0), room.spectrum).median()
    assert fitted > mean + 3


def test_same_seed_same_model(room):
    a, b = (fit(room, QUICK, progress=False).synthesize(room.position) for _ in range(2))
    assert torch.equal(a, b)
    other = fit(room, replace(QUICK, seed=1), progress=False).synthesize(room.position)
    assert not torch.equal(a, other)


def test_paper_preset_is_the_paper():
    paper = FitConfig.paper()
    assert paper.model.n_primitives == 10_000
    assert paper.model.deformation == "per_primitive_mlp"
    assert paper.model.components == ("mean", "response", "attenuation")
    assert (paper.rate, paper.deformation_rate, paper.ssim_weight, paper.smoothing) == (1e-2, 8e-3, 0.3, 1.0)
    assert paper.stop_mean


def test_paper_model_fits_a_toy(room):
    paper = FitConfig.paper(steps=40, check_every=20)
    config = replace(paper, model=replace(paper.model, n_primitives=20))
    records = []
    fit(room, config, progress=False, on_record=records.append)
    assert [(r["stage"], r["step"]) for r in records] == [("final", 20), ("final", 40)]


def test_smoothing_is_annealed(room):
    config = replace(QUICK, smoothing=1.0, smoothing_steps=100)
    kernel = choose_kernel(room.position, room.spectrum, folds(room.position, "random", 0))
    config = replace(config, model=replace(config.model, rank=4))
    optimisation = Optimisation(config, 200, room, kernel, "cpu")
    optimisation.step = optimisation.coarse_steps
    assert optimisation.smoothing() == pytest.approx(2 / len(room) ** (1 / 3))
    optimisation.step = optimisation.coarse_steps + 50
    assert optimisation.smoothing() == pytest.approx(1 / len(room) ** (1 / 3))
    optimisation.step = optimisation.coarse_steps + 101
    assert optimisation.smoothing() == 0


def test_interrupted_fit_goes_on_to_the_same_bits(room, tmp_path):
    config = FitConfig(steps=60, check_every=30)
    records = []
    whole = fit(room, config, progress=False, on_record=records.append).synthesize(room.position)
    runs = list(dict.fromkeys((r["stage"], r["n_primitives"]) for r in records))
    assert [stage for stage, _ in runs].count("final") == 1

    class Stop(Exception):
        pass

    for stop_at in ((*runs[0], 30), (*runs[1], 60), (*runs[-1], 30)):

        def stop(record, stop_at=stop_at):
            if (record["stage"], record["n_primitives"], record["step"]) == stop_at:
                raise Stop

        state = tmp_path / "-".join(map(str, stop_at))
        with pytest.raises(Stop):
            fit(room, config, progress=False, checkpoint=state, on_record=stop)
        rest = []
        again = fit(room, config, progress=False, checkpoint=state, on_record=rest.append)
        assert [describe(r) for r in rest] == [describe(r) for r in records]  # the history is whole
        assert torch.equal(again.synthesize(room.position), whole)


def describe(record):
    return record["stage"], record["n_primitives"], record["step"], record["loss"], record["validation"]


def test_finds_a_size_and_a_length(room):
    """What was chosen is among what was tried, and only the final run sees all spectra."""
    records = []
    model = fit(room, FitConfig(check_every=1000), progress=False, on_record=records.append)
    tried = [(r["n_primitives"], r["steps"]) for r in records if r["stage"] == "search"]
    final = records[-1]
    assert final["stage"] == "final"
    assert model.config.n_primitives == final["n_primitives"]
    assert (final["n_primitives"], final["steps"]) in tried
    assert len(tried) == len(set(tried))


@pytest.mark.parametrize(
    ("losses", "found", "tried"),
    [
        ([8, 4, 2, 1, 0.5], 160, 5),  # the more the better: the largest
        ([8, 4, 2, 2.1, 2.2, 0.1], 40, 5),  # two doublings in vain end the search
        ([8, 4, 3.98, 2, 1.995, 1.99], 80, 6),  # one in vain does not; a difference of less than 1 % is chance
        ([3, 3, 3], 10, 3),  # nothing helps: the smallest
        ([0, 0, 0], 10, 3),
    ],
)
def test_doubling_search_finds_the_smallest_that_does_as_well_as_any(losses, found, tried):
    asked = []

    def loss(size):
        asked.append(size)
        return losses[len(asked) - 1]

    assert doubling_search(loss, 10, 10 * 2 ** (len(losses) - 1), patience=2) == found
    assert asked == [10 * 2**i for i in range(tried)]


def test_refuses_the_state_of_another_fit(room, tmp_path):
    fit(room, replace(QUICK, steps=50), progress=False, checkpoint=tmp_path / "state")
    with pytest.raises(InputError, match="another fit"):
        fit(room, QUICK, progress=False, checkpoint=tmp_path / "state")


def test_loss_that_is_not_finite_stops_and_keeps_the_last_good_state(room, tmp_path, monkeypatch):
    state = tmp_path / "state"
    honest = Optimisation.loss

    def breaks(self, drawn, measured):
        return honest(self, drawn, measured) * (float("nan") if self.step == 120 else 1)

    monkeypatch.setattr(Optimisation, "loss", breaks)
    with pytest.raises(FitError, match="step 120"):
        fit(room, QUICK, progress=False, checkpoint=state)
    monkeypatch.undo()
    records = []
    fit(room, QUICK, progress=False, checkpoint=state, on_record=records.append)
    assert [record["step"] for record in records][:3] == [50, 100, 150]  # went on from the state at 100
    assert records[1]["elapsed"] < records[2]["elapsed"]


def test_refuses_too_few_spectra_and_what_is_not_finite(room):
    with pytest.raises(InputError, match="at least 10"):
        fit(room.subset(torch.arange(9)), QUICK, progress=False)
    broken = room.spectrum.clone()
    broken[7, 3, 3] = float("nan")
    with pytest.raises(InputError, match="training spectrum 7"):
        fit(replace(room, spectrum=broken), QUICK, progress=False)


def test_folds_partition_and_repeat(room):
    for kind in ("random", "block"):
        fold = folds(room.position, kind, 3)
        assert fold.bincount().tolist() == [8] * 5
        assert torch.equal(fold, folds(room.position, kind, 3))


def test_recovers_a_scene_that_it_can_represent_exactly(generator):
    """Spectra drawn from known primitives and motions: a fit of the same size that starts beside the truth returns to it."""
    position = torch.rand(60, 3, generator=generator, dtype=torch.float64)
    grid = AngularGrid.hemisphere(15, 60)
    config = ModelConfig(n_primitives=4, rank=2, components=("mean", "response"))
    kernel = Kernel(long=2.0, short=1.0, share=0.2, noise=1e-3)
    truth = SwiftWRF.make(config, grid, position, kernel, generator=generator)
    with torch.no_grad():
        truth.primitives.response.mul_(3)
        truth.deformation.field.coefficient.normal_(std=1.0, generator=generator)
    scene = Spectra(
        name="exact",
        position=position,
        spectrum=truth(truth.normalise(position)).detach(),
        grid=grid,
        label=torch.zeros(60, 2, dtype=torch.float64),
        line_of_sight=torch.ones(60, dtype=torch.bool),
        moving="transmitter",
        index=torch.arange(60),
    )
    fitting = FitConfig(model=config, rate=3e-3, prior_weight=0.0, ssim_weight=0.0, pixel_loss="l2")
    optimisation = Optimisation(fitting, 300, scene, kernel, "cpu")
    start = {
        name: value + 0.05 * torch.randn(value.shape, generator=generator) for name, value in truth.named_parameters()
    }
    optimisation.model.load_state_dict(start, strict=False)
    optimisation.average.module.load_state_dict(start, strict=False)

    @torch.no_grad()
    def apart(model):
        """Root mean square error of the means at the positions [rad]."""
        means = [m.gaussians(optimisation.position).mean for m in (model, truth)]
        return float((means[0] - means[1]).square().mean().sqrt())

    before = psnr(optimisation.model(optimisation.position).detach(), scene.spectrum).median()
    began = apart(optimisation.model)
    while optimisation.step < 300:
        optimisation.advance()
    after = psnr(optimisation.result(optimisation.position).detach(), scene.spectrum).median()
    assert before < 35 < 50 < after
    assert apart(optimisation.result) < 0.5 * began  # the spectra do not tell more at this length
