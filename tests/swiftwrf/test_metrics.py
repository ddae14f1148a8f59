import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from swiftwrf.metrics import (
    angle_errors,
    covered,
    median_interval,
    method_summary,
    ssim,
    summary,
)


def test_ssim_is_that_of_scikit_image(generator):
    a, b = torch.rand(2, 4, 20, 33, generator=generator, dtype=torch.float64)
    b = 0.7 * a + 0.3 * b
    wanted = [structural_similarity(x.numpy(), y.numpy(), data_range=1) for x, y in zip(a, b, strict=True)]
    np.testing.assert_allclose(ssim(a, b).numpy(), wanted, rtol=1e-10)


def test_angle_errors_wrap_and_shrink_at_the_pole():
    degrees = torch.tensor([[359.0, 10.0], [90.0, 89.0]]), torch.tensor([[1.0, 12.0], [270.0, 89.0]])
    errors = angle_errors(*(d.deg2rad() for d in degrees))
    assert errors["azimuth"].rad2deg().tolist() == pytest.approx([2, 180], abs=1e-4)
    assert errors["elevation"].rad2deg().tolist() == pytest.approx([2, 0], abs=1e-4)
    assert errors["great_circle"].rad2deg()[1].item() == pytest.approx(2, abs=1e-3)


def test_median_interval_covers_as_often_as_it_says():
    draws = np.random.default_rng(0).exponential(size=(2000, 40))
    covered = [low <= np.log(2) <= high for low, high in map(median_interval, draws)]
    assert 0.94 < np.mean(covered) < 0.99


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=50))
def test_summary_is_ordered(values):
    s = summary(values)
    assert s["low"] <= s["median"] <= s["high"]
    assert s["median"] <= s["p90"] + 1e-9 or len(values) < 3
    assert s["n"] == len(values)


def test_a_first_ssim_under_inference_mode_leaves_later_gradients_alone(generator):
    """Cached tensors must work in inference mode and outside."""
    a = torch.rand(23, 41, generator=generator, requires_grad=True)  # sizes that no other test asks for
    with torch.inference_mode():
        ssim(a, a)
    ssim(a, a.detach() / 2).backward()
    assert a.grad.isfinite().all()


def test_four_fifths_of_a_normal_variable_are_covered():
    noise = torch.randn(3, 200, 200, generator=torch.Generator().manual_seed(0))
    share = covered(torch.zeros_like(noise), 2 * torch.ones_like(noise), 2 * noise)
    assert share.tolist() == pytest.approx([0.8] * 3, abs=0.01)
    assert covered(noise, torch.zeros_like(noise), noise).tolist() == [1, 1, 1]


@pytest.mark.parametrize(("n_pairs", "mean", "has_interval"), [(0, np.nan, False), (9, 1.0, False), (10, 1.0, True)])
def test_a_method_without_error_at_most_rows_has_few_pairs(n_pairs, mean, has_interval):
    error = np.concatenate([np.ones(12), np.where(np.arange(12) < n_pairs, 2.0, np.nan)])
    table = pd.DataFrame({"method": ["a"] * 12 + ["b"] * 12, "index": [*range(12)] * 2, "error": error})
    found = method_summary(table, "error", "a").loc["b"]
    assert found["n"] == n_pairs
    assert found["difference"] == pytest.approx(mean, nan_ok=True)
    assert np.isfinite(found[["difference_low", "difference_high"]].tolist()).tolist() == [has_interval] * 2
