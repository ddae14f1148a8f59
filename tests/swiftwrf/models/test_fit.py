"""Fitting: what it reaches, what it refuses, how it goes on."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from small import glances

from swiftwrf import AngularGrid, FitConfig, FitError, InputError, ModelConfig, Spectra, SwiftWRF, fit, make_model
from swiftwrf.data.splits import folds
from swiftwrf.data.store import Store
from swiftwrf.gp import GaussianProcess, Kernel, choose_kernel
from swiftwrf.metrics import covered, psnr
from swiftwrf.models.swiftwrf.field import DeformableGaussians
from swiftwrf.models.swiftwrf.fit import doubling_search
from swiftwrf.models.swiftwrf.optimise import Optimisation
from swiftwrf.rasterize import reference

QUICK = FitConfig(model=ModelConfig(n_primitives=24), steps=80, check_every=20)  # by gradient


def test_fit_beats_the_mean_spectrum(room):
    wrf = fit(room, replace(QUICK, steps=200))
    fitted = psnr(wrf.synthesize(room.position), room.spectrum).median()
    mean = psnr(room.spectrum.mean(dim=0), room.spectrum).median()
    assert fitted > mean + 3


def test_same_seed_same_model(room):
    a, b = (fit(room, QUICK).synthesize(room.position) for _ in range(2))
    assert torch.equal(a, b)
    other = fit(room, replace(QUICK, seed=1)).synthesize(room.position)
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
    fit(room, config, on_record=records.append)
    assert [(r["stage"], r["step"]) for r in records] == [("final", 20), ("final", 40)]


def test_smoothing_is_annealed(room):
    config = replace(QUICK, steps=200, smoothing=1.0, smoothing_steps=100)
    kernel = choose_kernel(room.position, room.spectrum, folds(room.position, "random", 0))
    config = replace(config, model=replace(config.model, rank=4))
    optimisation = Optimisation(config, room, kernel, "cpu")
    optimisation.step = optimisation.coarse_steps
    assert optimisation.smoothing() == pytest.approx(2 / len(room) ** (1 / 3))
    optimisation.step = optimisation.coarse_steps + 50
    assert optimisation.smoothing() == pytest.approx(1 / len(room) ** (1 / 3))
    optimisation.step = optimisation.coarse_steps + 101
    assert optimisation.smoothing() == 0


class Stop(Exception):
    pass


@pytest.mark.parametrize(
    ("config", "stop_at"),
    [(replace(QUICK, steps=90, check_every=30), ("final", 24, 60)), (FitConfig(), ("search", 32, 0))],
    ids=["gradient", "regression"],
)
def test_interrupted_fit_goes_on_to_the_same_bits(room, tmp_path, config, stop_at):
    records = []
    whole = fit(room, config, on_record=records.append).synthesize(room.position)
    assert stop_at in [describe(r)[:3] for r in records]

    def stop(record):
        if describe(record)[:3] == stop_at:
            raise Stop

    state = tmp_path / "state"
    with pytest.raises(Stop):
        fit(room, config, checkpoint=state, on_record=stop)
    rest = []
    again = fit(room, config, checkpoint=state, on_record=rest.append)
    assert [describe(r) for r in rest] == [describe(r) for r in records]  # the history is whole
    assert torch.equal(again.synthesize(room.position), whole)


def scene_of(position, spectrum, grid):
    return Spectra(
        name="exact",
        position=position,
        store=Store(spectrum),
        grid=grid,
        label=torch.zeros(len(position), 2, dtype=torch.float64),
        line_of_sight=torch.ones(len(position), dtype=torch.bool),
        moving="transmitter",
        index=torch.arange(len(position)),
    )


def describe(record):
    return record["stage"], record["n_primitives"], record["step"], record["loss"], record["validation"]


def test_finds_a_size(room):
    """The chosen size is among the candidates, and predicts held-out spectra as well as any."""
    records = []
    model = fit(room, on_record=records.append)
    tried = {r["n_primitives"]: r["validation"] for r in records if r["stage"] == "search"}
    n = records[-1]["n_primitives"]
    assert records[-1]["stage"] == "final"
    assert model.field.config.n_primitives == n
    assert tried[n] <= 1.002 * min(tried.values())
    assert all(tried[smaller] > 1.002 * min(tried.values()) for smaller in tried if smaller < n)


def test_regression_draws_what_the_process_on_the_pixels_predicts(room):
    """With enough primitives to draw any spectrum of the room, and all that is measured known."""
    unseen = room.subset(torch.arange(0, 40, 4))
    known = room.subset(torch.tensor([i for i in range(40) if i % 4]))
    model = fit(known, FitConfig(model=ModelConfig(n_primitives=256), max_azimuths=0))
    kernel = choose_kernel(known.position, known.spectrum, folds(known.position, "random", 0))
    mean = known.spectrum.mean(dim=0)
    change = (known.spectrum - mean).flatten(1)
    weights = GaussianProcess(kernel, known.position).weights(unseen.position)[1].float()
    predicted = (mean + (weights @ change).reshape(unseen.spectrum.shape)).clamp(0, 1)
    assert psnr(model.synthesize(unseen.position), predicted).min() > 38


def test_regression_recovers_fields_of_primitives(generator):
    """Spectra of primitives whose responses are smooth in position are predicted where none was measured."""
    position = 2 * torch.rand(150, 3, generator=generator, dtype=torch.float64)
    grid = AngularGrid.hemisphere(15, 60)
    mean = torch.tensor([[1.0, 0.5], [3.0, 0.9], [5.0, 0.4]])
    cholesky = torch.tensor([[0.5, 0.0, 0.3]] * 3)
    kernel = reference.kernels(mean, cholesky, grid, cutoff=1e-4)
    response = 0.4 + 0.3 * torch.sin(position @ torch.randn(3, 3, generator=generator, dtype=torch.float64)).float()
    spectrum = torch.einsum("bn,nhw->bhw", response, kernel).clamp(0, 1)
    scene = scene_of(position, spectrum, grid)
    model = fit(scene.subset(torch.arange(120)))
    assert psnr(model.synthesize(position[120:]), spectrum[120:]).median() > 35


def test_regression_is_the_same_at_any_number_of_threads(room):
    def drawn(threads):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            return fit(room, FitConfig(model=ModelConfig(n_primitives=32))).state()[0]
        finally:
            torch.set_num_threads(before)

    one, two = drawn(1), drawn(2)
    for name, value in one.items():
        torch.testing.assert_close(two[name], value, atol=1e-5, rtol=1e-5, equal_nan=True, msg=name)


@pytest.mark.parametrize("name", ["swiftwrf", "gp", "coarray", "hybrid"])
def test_standard_deviations_are_calibrated(built_in_room, name):
    """75 to 85 % of the pixels of unseen spectra lie within 1.28 standard deviations; these grow with the distance."""
    train, test = built_in_room
    with glances():
        model = make_model(name).fit(train)
    found = model.predict(test.position)
    assert 0.75 < covered(found.mean, found.std, test.spectrum).mean() < 0.85
    near, far = (model.predict(position).std for position in (train.position, test.position + 100))
    assert near.mean() < found.std.mean() < far.mean()


@pytest.mark.parametrize("name", ["gp", "coarray"])
def test_standard_deviations_follow_updates_and_another_kernel(built_in_room, name):
    train, test = built_in_room
    first = make_model(name).fit(train.subset(torch.arange(60)))
    both = first.update(train.subset(torch.arange(60, len(train))))
    before, after = (model.predict(test.position).std.mean() for model in (first, both))
    assert after < before
    found = both.with_chosen_kernel().predict(test.position)
    assert 0.7 < covered(found.mean, found.std, test.spectrum).mean() < 0.9


def test_standard_deviations_on_another_grid_are_those_of_the_nearest_directions(built_in_room):
    train, test = built_in_room
    model = make_model("coarray").fit(train)
    own, fine = (model.predict(test.position, grid).std for grid in (None, AngularGrid.hemisphere(30, 120)))
    assert fine.shape == (len(test), 30, 120)
    torch.testing.assert_close(fine[:, 1::2, ::2], own)


def test_a_fit_by_gradient_descent_has_no_standard_deviation(room):
    found = fit(room, replace(QUICK, steps=20)).predict(room.position)
    assert found.std is None
    with pytest.raises(InputError, match="no standard deviation"):
        found.interval()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FitConfig(model=ModelConfig(deformation="per_primitive_mlp")), "give a number of steps"),
        (lambda: FitConfig(model=ModelConfig(components=("mean",))), "give a number of steps"),
        (lambda: FitConfig(steps=10), "needs a number of primitives"),
    ],
)
def test_refuses_what_does_not_fit_together(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_a_fit_like_another_keeps_its_number_of_primitives(room):
    first = fit(room, FitConfig(model=ModelConfig(n_primitives=24)))
    records = []
    again = SwiftWRF(seed=1).fit(room.subset(torch.arange(30)), like=first, on_record=records.append)
    assert [(r["stage"], r["n_primitives"]) for r in records] == [("final", 24)]
    assert again.field.config.n_primitives == 24


def test_options_take_precedence_over_a_fit_like_another(room):
    first = fit(room, FitConfig(model=ModelConfig(n_primitives=24)))
    asked = ModelConfig(n_primitives=8, axis_aligned=True, rank=3)
    again = SwiftWRF(steps=3, check_every=1, model=asked).fit(room, like=first)
    assert again.field.config == again.config.model == asked
    searched = SwiftWRF(model=ModelConfig(axis_aligned=True, rank=3)).fit(room, like=first)
    assert searched.field.config == replace(asked, n_primitives=24)


@pytest.mark.parametrize(
    ("losses", "found", "tried"),
    [
        ([8, 4, 2, 1, 0.5], 160, 5),  # the more the better: the largest
        ([8, 4, 2, 2.1, 2.2, 0.1], 40, 5),  # two doublings in vain end the search
        ([8, 4, 3.998, 2, 1.999, 1.998], 80, 6),  # one in vain does not; a difference of less than 0.4 % does not count
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
    fit(room, replace(QUICK, steps=20), checkpoint=tmp_path / "state")
    with pytest.raises(InputError, match="another fit"):
        fit(room, QUICK, checkpoint=tmp_path / "state")


def test_loss_that_is_not_finite_stops_and_keeps_the_last_good_state(room, tmp_path, monkeypatch):
    state = tmp_path / "state"
    honest = Optimisation.loss

    def breaks(self, drawn, measured):
        return honest(self, drawn, measured) * (float("nan") if self.step == 50 else 1)

    monkeypatch.setattr(Optimisation, "loss", breaks)
    with pytest.raises(FitError, match="step 50"):
        fit(room, QUICK, checkpoint=state)
    monkeypatch.undo()
    records = []
    fit(room, QUICK, checkpoint=state, on_record=records.append)
    assert [record["step"] for record in records][:3] == [20, 40, 60]  # went on from the state at 40
    assert records[1]["elapsed"] < records[2]["elapsed"]


def test_refuses_too_few_spectra_and_what_is_not_finite(room):
    with pytest.raises(InputError, match="at least 10"):
        fit(room.subset(torch.arange(9)), QUICK)
    broken = room.spectrum.clone()
    broken[7, 3, 3] = float("nan")
    with pytest.raises(InputError, match="training spectrum 7"):
        fit(replace(room, store=Store(broken)), QUICK)


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
    truth = DeformableGaussians.initial(config, grid, position, kernel, generator=generator)
    with torch.no_grad():
        truth.primitives.response.mul_(3)
        truth.deformation.field.coefficient.normal_(std=1.0, generator=generator)
    scene = scene_of(position, truth(truth.normalise(position)).detach(), grid)
    fitting = FitConfig(model=config, steps=300, rate=3e-3, prior_weight=0.0, ssim_weight=0.0, pixel_loss="l2")
    optimisation = Optimisation(fitting, scene, kernel, "cpu")
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
    assert apart(optimisation.result) < 0.5 * began  # the spectra determine no more at this length


def test_a_fit_that_ended_worse_is_refused_again(room, tmp_path, monkeypatch):
    """Its state is kept, and the same call must not take it for a result."""
    honest = Optimisation.record

    def record(self, loss):
        self.first_loss = -1.0  # better than any loss
        return honest(self, loss)

    monkeypatch.setattr(Optimisation, "record", record)
    for _ in range(2):
        with pytest.raises(FitError, match="worse than the -1 it began with"):
            fit(room, replace(QUICK, steps=20), checkpoint=tmp_path / "state")
