"""Angles, directions and poses; distances between positions, on the CPU and on a GPU."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from swiftwrf import AngularGrid
from swiftwrf.array.angles import angular_distance, to_angles, to_direction, wrap
from swiftwrf.positions import MAX_COORDINATE, distance

ANGLE = st.floats(-50, 50, allow_nan=False)


def test_the_last_row_of_a_hemisphere_is_the_normal():
    grid = AngularGrid.hemisphere(90, 360)
    assert grid.shape == (90, 360)
    assert grid.elevation[0].item() == pytest.approx(math.radians(1))
    assert grid.elevation[-1].item() == pytest.approx(math.pi / 2)
    assert grid.azimuth[90].item() == pytest.approx(math.pi / 2)


def test_coarsen_keeps_the_middle_of_pixels():
    coarse = AngularGrid.hemisphere(90, 360).coarsen(2)
    assert coarse.shape == (45, 180)
    assert coarse.elevation[0].rad2deg().item() == pytest.approx(1.5)
    assert coarse.azimuth[1].rad2deg().item() == pytest.approx(2.5)


def test_what_comes_from_behind_is_folded_up():
    azimuth, elevation = to_angles(torch.tensor([[1.0, 1.0, -math.sqrt(2)]]))
    assert azimuth.rad2deg().item() == pytest.approx(45)
    assert elevation.rad2deg().item() == pytest.approx(45)


@given(ANGLE, st.floats(0.01, math.pi / 2 - 0.01))
def test_angles_and_direction_are_inverse(azimuth, elevation):
    given = torch.tensor([azimuth, elevation], dtype=torch.float64)
    a, e = to_angles(to_direction(*given))
    assert 0 <= a < 2 * math.pi
    assert abs(wrap(a - azimuth)) < 1e-9
    assert abs(e - elevation) < 1e-9


@given(ANGLE, st.integers(-5, 5))
def test_wrap_ignores_turns(angle, turns):
    wrapped = wrap(torch.tensor(angle + 2 * math.pi * turns, dtype=torch.float64))
    assert abs(wrapped) <= math.pi + 1e-9
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)


def test_great_circle_of_tiny_angles_does_not_round_to_zero():
    a = torch.tensor([1.0, 0.0, 0.0])
    b = torch.tensor([1.0, 1e-6, 0.0])
    assert angular_distance(a, b).item() == pytest.approx(1e-6, rel=1e-4)  # acos in float32 gives 0
    assert angular_distance(a, -a).item() == pytest.approx(math.pi)


# distances


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_distances_of_close_pairs_far_from_the_origin(device):
    origin = torch.tensor([4.0e6, 5.0e5, 0.0], dtype=torch.float64, device=device)
    offset = torch.tensor([[3e-3, 4e-3, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 2.0]], dtype=torch.float64, device=device)
    found = distance(origin + offset, origin[None])
    torch.testing.assert_close(
        found.cpu(), torch.tensor([[5e-3], [0.0], [2.0]], dtype=torch.float64), atol=1e-9, rtol=0
    )


class OnGpu(torch.Tensor):
    """A tensor in main memory that takes the way of tensors on a GPU."""

    is_cuda = True


def test_distances_within_groups_are_those_of_each_group_on_a_gpu(generator):
    a, b = (torch.rand(4, n, 3, generator=generator) for n in (1, 5))
    expected = torch.stack([distance(x, y) for x, y in zip(a, b, strict=True)])
    torch.testing.assert_close(distance(a.as_subclass(OnGpu), b).as_subclass(torch.Tensor), expected)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_gradient_where_two_positions_coincide(device):
    a = torch.tensor([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]], device=device, requires_grad=True)
    (gradient,) = torch.autograd.grad(distance(a, torch.zeros(1, 3, device=device)).sum(), a)
    torch.testing.assert_close(gradient.cpu(), torch.tensor([[0.0, 0.0, 0.0], [0.6, 0.8, 0.0]]))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_distance_of_infinity_is_finite(device):
    found = distance(torch.zeros(2, 3, device=device), torch.full((1, 3), torch.inf, device=device))
    assert found.flatten().tolist() == pytest.approx([MAX_COORDINATE] * 2)
