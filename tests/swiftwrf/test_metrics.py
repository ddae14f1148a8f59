import inspect
import math
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

import swiftwrf
from swiftwrf.contrib.comparison.errors import (
    median_interval,
    method_summary,
    paired_change,
    paired_difference,
    resampled_median,
    summary,
)
from swiftwrf.locate import Posterior
from swiftwrf.metrics import LEVEL, angle_errors, covered, interval_factor, ssim


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


def test_ssim_of_a_single_row_by_windows_of_seven(generator):
    a, b = torch.rand((2, 5, 1, 20), generator=generator, dtype=torch.float64)
    expected = []
    for one, other in zip(a[:, 0].numpy(), b[:, 0].numpy(), strict=True):
        values = []
        for start in range(14):
            x, y = one[start : start + 7], other[start : start + 7]
            covariance = np.cov(x, y)
            values.append(
                (2 * x.mean() * y.mean() + 1e-4)
                * (2 * covariance[0, 1] + 9e-4)
                / ((x.mean() ** 2 + y.mean() ** 2 + 1e-4) * (covariance[0, 0] + covariance[1, 1] + 9e-4))
            )
        expected.append(np.mean(values))
    assert ssim(a, b).numpy() == pytest.approx(np.array(expected), abs=1e-12)


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


@pytest.mark.parametrize("n", [1, 3, 4, 9, 57, 400])
def test_the_factor_of_one_row_a_place_is_an_ascending_score(n):
    """Number ceil(0.8 (n + 1)) of n, or the largest if there are fewer."""
    score = np.random.default_rng(n).exponential(size=n)
    wanted = np.sort(score)[min(math.ceil((n + 1) * 0.8 - 1e-9), n) - 1]
    assert interval_factor(torch.from_numpy(score), torch.randperm(n)) == wanted


def test_places_count_alike_in_a_factor(generator):
    """The smallest score below which the mean fraction of a place's scores is 0.8 (P + 1) / P."""
    place = torch.randint(12, (300,), generator=generator) ** 2 // 11  # places of 10 to 70 rows
    score = torch.rand(300, 5, generator=generator) * (1 + place[:, None])
    score[::7, 2], score[3, 1] = torch.nan, torch.inf
    parts = [score[place == number].numpy().ravel() for number in place.unique()]
    parts = [part[np.isfinite(part)] for part in parts]
    needed = 0.8 * (len(parts) + 1) / len(parts)
    ascending = np.sort(np.concatenate(parts))
    wanted = next(value for value in ascending if np.mean([(part <= value).mean() for part in parts]) >= needed - 1e-9)
    assert interval_factor(score, place) == wanted
    again = torch.cat([score, score[place == 2].repeat(9, 1)]), torch.cat([place, place[place == 2].repeat(9)])
    assert interval_factor(*again) == wanted


@pytest.mark.parametrize("n_places", [9, 24, 100])
def test_intervals_hold_at_a_new_place(n_places):
    """With places of 1 to 30 rows, whose errors have a common scale."""
    draw, inside = np.random.default_rng(n_places), []
    for _ in range(400):
        rows = draw.integers(1, 31, n_places)
        place, scale = np.arange(n_places).repeat(rows), draw.gamma(2.0, size=n_places).repeat(rows)
        score = scale * np.abs(draw.normal(size=len(place)))
        factor = interval_factor(torch.from_numpy(score), torch.from_numpy(place))
        inside.append((draw.gamma(2.0) * np.abs(draw.normal(size=30)) <= factor).mean())
    assert LEVEL - 0.015 < np.mean(inside) < LEVEL + 0.015 + 1 / (n_places + 1)


def test_all_intervals_and_regions_have_one_level():
    root = Path(swiftwrf.__file__).parent.parent
    files = [file for package in ("swiftwrf", "augment", "tasks") for file in (root / package).rglob("*.py")]
    assert [file.stem for file in files if re.search(r"^LEVEL\b.* = ", file.read_text(), re.MULTILINE)] == ["metrics"]
    for method in (swiftwrf.Prediction.interval, Posterior.credible_radius):
        assert inspect.signature(method).parameters["level"].default == LEVEL == 0.8


@pytest.mark.parametrize(("n_pairs", "mean", "has_interval"), [(0, np.nan, False), (9, 1.0, False), (10, 1.0, True)])
def test_a_method_without_error_at_most_rows_has_few_pairs(n_pairs, mean, has_interval):
    error = np.concatenate([np.ones(12), np.where(np.arange(12) < n_pairs, 2.0, np.nan)])
    table = pd.DataFrame({"method": ["a"] * 12 + ["b"] * 12, "index": [*range(12)] * 2, "error": error})
    found = method_summary(table, "error", "a").loc["b"]
    assert found["n"] == n_pairs
    assert found["difference"] == pytest.approx(mean, nan_ok=True)
    assert np.isfinite(found[["difference_low", "difference_high"]].tolist()).tolist() == [has_interval] * 2


@pytest.mark.parametrize("n_rows", [5, 6, 90])
def test_intervals_over_places_are_those_of_rows_that_are_written_out(n_rows, monkeypatch):
    monkeypatch.setattr("swiftwrf.contrib.comparison.errors.MAX_DRAWN", 50)  # several batches
    draw = np.random.default_rng(4)
    errors, other = draw.exponential(size=(n_rows, 3)), draw.exponential(size=(n_rows, 3)).round(1)  # ties
    place = draw.permutation(np.arange(n_rows) ** 2 % (n_rows // 2))[:, None] * [1.0, 0.5]  # of several sizes
    names, number = np.unique(place, axis=0, return_inverse=True)
    draw = np.random.default_rng(0)
    samples = [draw.integers(len(names), size=len(names)) for _ in range(1000)]
    samples = [np.concatenate([np.flatnonzero(number == each) for each in sample]) for sample in samples]
    found = summary(errors[:, 0], place)
    expected = np.percentile([np.median(errors[rows, 0]) for rows in samples], (2.5, 97.5))
    np.testing.assert_allclose([found["low"], found["high"]], expected)
    found = paired_change(errors, other, place, n=1000)
    changes = [np.median(other[rows]) / np.median(errors[rows]) - 1 for rows in samples]
    np.testing.assert_allclose([found["low"], found["high"]], np.percentile(changes, (2.5, 97.5)))
    index = pd.MultiIndex.from_arrays([range(n_rows), number], names=["index", "place"])
    pairs = pd.DataFrame({"a": errors[:, 0], "b": other[:, 0]}, index)
    expected = np.percentile([(errors - other)[rows, 0].mean() for rows in samples], (2.5, 97.5))
    np.testing.assert_allclose(paired_difference(pairs, "a", "b", min_groups=2)[1:], expected)


def test_a_median_of_one_value_and_of_groups_that_a_sample_lacks():
    times = np.array([[2.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    assert resampled_median([3.0, 1.0], np.array([0, 1]))(times).tolist() == [3.0, 1.0, 2.0]
    assert resampled_median([4.0], np.array([0]))(np.ones((2, 1))).tolist() == [4.0, 4.0]
