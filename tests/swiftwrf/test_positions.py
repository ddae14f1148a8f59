"""Distances between positions, on the CPU and on a GPU."""

import pytest
import torch

from swiftwrf.positions import MAX_COORDINATE, distance


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_distances_of_close_pairs_far_from_the_origin(device):
    origin = torch.tensor([4.0e6, 5.0e5, 0.0], dtype=torch.float64, device=device)
    offset = torch.tensor([[3e-3, 4e-3, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 2.0]], dtype=torch.float64, device=device)
    found = distance(origin + offset, origin[None])
    torch.testing.assert_close(
        found.cpu(), torch.tensor([[5e-3], [0.0], [2.0]], dtype=torch.float64), atol=1e-9, rtol=0
    )


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_gradient_where_two_positions_coincide(device):
    a = torch.tensor([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]], device=device, requires_grad=True)
    (gradient,) = torch.autograd.grad(distance(a, torch.zeros(1, 3, device=device)).sum(), a)
    torch.testing.assert_close(gradient.cpu(), torch.tensor([[0.0, 0.0, 0.0], [0.6, 0.8, 0.0]]))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_distance_of_infinity_is_finite(device):
    found = distance(torch.zeros(2, 3, device=device), torch.full((1, 3), torch.inf, device=device))
    assert found.flatten().tolist() == pytest.approx([MAX_COORDINATE] * 2)
