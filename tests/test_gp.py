"""The Gaussian process: kernel, its choice, regression, smooth fields."""

from __future__ import annotations

import numpy as np
import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import Matern

from swiftwrf.gp import MIN_RANK, GaussianProcess, Kernel, SmoothField, choose_kernel, choose_rank

KERNEL = Kernel(long=1.0, short=0.3, share=0.6, noise=1e-2)


def test_regression_is_that_of_scikit_learn(generator):
    known, asked = (torch.rand(n, 3, generator=generator, dtype=torch.float64) for n in (30, 7))
    values = torch.randn(30, generator=generator, dtype=torch.float64)
    process = GaussianProcess(KERNEL, known)
    kernel = 0.6 * Matern(1.0, nu=0.5) + 0.4 * Matern(0.3, nu=1.5)
    theirs = GaussianProcessRegressor(kernel, alpha=1e-2, optimizer=None).fit(known, values)
    mean, deviation = theirs.predict(asked, return_std=True)
    np.testing.assert_allclose(process.weights(asked) @ values, mean, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(process.variance(asked).sqrt(), deviation, rtol=1e-6)


def test_kernel_is_positive_definite_and_one_at_home(generator):
    position = torch.rand(40, 3, generator=generator, dtype=torch.float64)
    gram = KERNEL(position, position)
    torch.testing.assert_close(gram.diagonal(), torch.ones(40, dtype=torch.float64))
    assert torch.linalg.eigvalsh(gram).min() > 0
    torch.testing.assert_close(KERNEL.scaled(3.0)(3 * position, 3 * position), gram)


def test_motion_is_a_draw_of_its_prior(generator):
    """With standard normal z the coefficients at the anchors have the prior's covariance k K^-1 k, close to k."""
    anchor = torch.rand(6, 3, generator=generator)
    basis = SmoothField(anchor, KERNEL, 20_000)
    with torch.no_grad():
        basis.coefficient.normal_(generator=generator)
    drawn = basis(anchor)
    covariance = (drawn @ drawn.T / 20_000).detach()
    gram = KERNEL(anchor, anchor)
    expected = gram @ torch.linalg.inv(gram + KERNEL.noise * torch.eye(6)) @ gram
    torch.testing.assert_close(covariance, expected, atol=0.04, rtol=0)


def test_kernel_choice_finds_smooth_and_rough_fields(generator):
    position = torch.rand(80, 3, generator=generator, dtype=torch.float64)
    fold = torch.arange(80) % 5
    smooth = torch.sin(position @ torch.rand(3, 64, generator=generator, dtype=torch.float64)).reshape(80, 8, 8)
    noise = torch.rand(80, 8, 8, generator=generator)
    assert choose_kernel(position, smooth, fold).noise < choose_kernel(position, noise, fold).noise


def test_rank_counts_what_can_be_predicted(generator):
    """Thirty smooth fields over three directions: their rank is found; noise has none."""
    position = torch.rand(200, 3, generator=generator, dtype=torch.float64)
    fold = torch.arange(200) % 5
    fields = torch.sin(position @ torch.randn(3, 40, generator=generator, dtype=torch.float64) * 4)
    smooth = (fields @ torch.randn(40, 64, generator=generator, dtype=torch.float64)).reshape(200, 8, 8)
    noise = torch.rand(200, 8, 8, generator=generator)
    assert 28 <= choose_rank(position, smooth, fold, choose_kernel(position, smooth, fold)) <= 40
    assert choose_rank(position, noise, fold, choose_kernel(position, noise, fold)) == MIN_RANK
