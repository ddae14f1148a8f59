"""The Gaussian process: kernel, its choice, regression, smooth fields."""

import numpy as np
import pytest
import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import Matern

from swiftwrf.gp import (
    GaussianProcess,
    Kernel,
    choose_kernel,
    held_out_errors,
    leave_folds_out,
    most_informative,
    principal_components,
    subsample,
)
from swiftwrf.gp.choice import MAX_LOCAL_ROWS, _local_errors
from swiftwrf.runtime.checkpoint import pack, unpack

KERNEL = Kernel(1.0, 0.3, matern12_weight=0.6, noise=1e-2)


def test_regression_is_that_of_scikit_learn(generator):
    known, asked = (torch.rand(n, 3, generator=generator, dtype=torch.float64) for n in (30, 7))
    values = torch.randn(30, generator=generator, dtype=torch.float64)
    process = GaussianProcess(KERNEL, known)
    kernel = 0.6 * Matern(1.0, nu=0.5) + 0.4 * Matern(0.3, nu=1.5)
    theirs = GaussianProcessRegressor(kernel, alpha=1e-2, optimizer=None).fit(known, values)
    mean, deviation = theirs.predict(asked, return_std=True)
    regressed = GaussianProcess(KERNEL, known, values[:, None])
    np.testing.assert_allclose(regressed.mean(asked)[:, 0], mean, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(process.variance(asked).sqrt(), deviation, rtol=1e-6)


def test_kernel_choice_finds_smooth_and_rough_fields(generator):
    position = torch.rand(80, 3, generator=generator, dtype=torch.float64)
    fold = torch.arange(80) % 5
    smooth = torch.sin(position @ torch.rand(3, 64, generator=generator, dtype=torch.float64)).reshape(80, 8, 8)
    noise = torch.rand(80, 8, 8, generator=generator)
    assert choose_kernel(position, smooth, fold).noise < choose_kernel(position, noise, fold).noise


def test_kernel_of_many_spectra_is_judged_at_their_own_density(generator):
    """The neighbours that predict a held-out spectrum are the nearest of all spectra in other folds, not of a sample."""
    position, spectrum = (torch.rand(500, *shape, generator=generator, dtype=torch.float64) for shape in ((3,), (2, 3)))
    fold, change = torch.arange(500) % 5, (spectrum - subsample(spectrum)[0].mean(dim=0)).flatten(1)
    errors = _local_errors(position, spectrum, fold)(KERNEL)
    for row, error in list(zip(subsample(torch.arange(500), rows=MAX_LOCAL_ROWS)[0], errors, strict=True))[::50]:
        kept = fold != fold[row]
        process = GaussianProcess(KERNEL, position[kept], change[kept], exact=False)
        torch.testing.assert_close(error, (process.mean(position[row, None])[0] - change[row]).square().mean())


def test_rank_counts_what_matters(generator):
    """Thirty directions in which smooth fields vary are all it takes, with or without a little noise."""
    position = torch.rand(200, 3, generator=generator, dtype=torch.float64)
    fold = torch.arange(200)
    fields = torch.sin(position @ torch.randn(3, 30, generator=generator, dtype=torch.float64) * 20)
    smooth = (fields @ torch.randn(30, 64, generator=generator, dtype=torch.float64)).reshape(200, 8, 8)
    noisy = smooth + 1e-3 * torch.randn(smooth.shape, generator=generator)
    for spectrum in (smooth, noisy):
        kernel = choose_kernel(position, spectrum, fold % 5)
        component = principal_components(position, spectrum, fold, kernel, omitted=5e-4)
        assert 26 <= len(component) <= 31
        gram = component[1:].flatten(1) @ component[1:].flatten(1).T
        torch.testing.assert_close(gram, gram.diagonal().diag(), atol=1e-3, rtol=0)
        assert len(principal_components(position, spectrum, fold, kernel, most=8)) == 9


@pytest.mark.parametrize("n_folds", [5, 40], ids=["a fifth", "one"])
def test_held_out_predictions_are_those_of_a_process_without_the_fold(generator, n_folds):
    position = torch.rand(40, 3, generator=generator, dtype=torch.float64)
    value = torch.randn(40, 2, generator=generator, dtype=torch.float64)
    fold = torch.arange(40) % n_folds
    precision = torch.linalg.inv(KERNEL.covariance(position))
    for number, (out, kept, weight, variance) in enumerate(leave_folds_out(KERNEL, position, fold)):
        assert torch.equal(out, (fold == number).nonzero()[:, 0])
        assert torch.equal(kept, (fold != number).nonzero()[:, 0])
        process = GaussianProcess(KERNEL, position[kept], value[kept])
        torch.testing.assert_close(weight @ value[kept], process.mean(position[out]))
        torch.testing.assert_close(variance, process.variance(position[out]) + KERNEL.noise)
        error = held_out_errors(precision, precision @ value, out)
        torch.testing.assert_close(error, value[out] - process.mean(position[out]))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_local_process_of_all_neighbours_is_the_exact_one(generator, dtype):
    known, asked = (torch.rand(n, 3, generator=generator, dtype=torch.float64) for n in (40, 6))
    value = torch.randn(40, 3, generator=generator, dtype=torch.float64)
    exact, local = (GaussianProcess(KERNEL, known, value.to(dtype), e) for e in (True, False))
    torch.testing.assert_close(local.mean(asked), exact.mean(asked).double(), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(local.variance(asked), exact.variance(asked))
    for process in (exact, local):
        again = unpack(GaussianProcess, *pack(process))
        assert torch.equal(again.mean(asked), process.mean(asked))


def test_local_predictions_condition_on_the_nearest_positions(generator):
    known = torch.rand(300, 3, generator=generator, dtype=torch.float64)
    value = torch.sin(5 * known)
    asked = known[:20] + 0.01
    exact, local = (GaussianProcess(KERNEL, known, value, e) for e in (True, False))
    torch.testing.assert_close(local.mean(asked), exact.mean(asked), atol=0.02, rtol=0)


@pytest.mark.parametrize("exact", [True, False])
def test_slopes_are_those_of_finite_differences(generator, exact):
    position = 2 * torch.rand(70, 3, generator=generator, dtype=torch.float64) - 1
    value = torch.sin(position @ torch.randn(3, 2, generator=generator, dtype=torch.float64))
    process = GaussianProcess(Kernel(8.0, 0.4, matern12_weight=0.05, noise=1e-2), position, value, exact)
    at = (1.6 * torch.rand(3, 3, generator=generator, dtype=torch.float64) - 0.8).requires_grad_()
    for quantity in (process.mean, process.variance):
        (slope,) = torch.autograd.grad(quantity(at).sum(), at)
        step = 1e-5 * torch.eye(3, dtype=torch.float64)[0]
        expected = (quantity(at + step) - quantity(at - step)).reshape(3, -1).sum(dim=1) / 2e-5
        torch.testing.assert_close(slope[:, 0], expected, atol=1e-3, rtol=1e-3)


def test_suggested_positions_beat_random_ones(generator):
    """The variance that is left is what a process with them measured has, and less than with as many at random."""
    known, candidate = (torch.rand(n, 3, generator=generator, dtype=torch.float64) for n in (20, 200))
    chosen, left = most_informative(KERNEL, known, candidate, 8)
    assert len(set(chosen.tolist())) == 8
    assert (left.diff() < 0).all()

    def remaining(rows):
        return GaussianProcess(KERNEL, torch.cat([known, candidate[rows]])).variance(candidate).mean()

    torch.testing.assert_close(left[-1], remaining(chosen), atol=1e-5, rtol=1e-4)
    random = [remaining(torch.randperm(200, generator=generator)[:8]) for _ in range(20)]
    assert left[-1] < min(random)


@pytest.mark.parametrize(("n", "places"), [(200, 1), (200, 7), (2100, 3)])
def test_repeated_positions_without_noise_have_an_answer(n, places):
    place = torch.rand(places, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    position = place[torch.arange(n) % places]
    value, kernel = position.sum(dim=1, keepdim=True), Kernel(1.0, 1.0, noise=0.0)
    process = GaussianProcess(kernel, position, value)
    for one in (process, process.updated(position[:5], value[:5])):
        torch.testing.assert_close(one.mean(place), place.sum(dim=1, keepdim=True), atol=1e-6, rtol=0)
        assert one.variance(place).max() < 1e-6
    for out, kept, weight, _ in leave_folds_out(kernel, position, torch.arange(n) // places % 2):
        torch.testing.assert_close(weight @ value[kept], value[out], atol=1e-5, rtol=0)
    assert len(most_informative(kernel, position, torch.rand(9, 3), 2)[0]) == 2
