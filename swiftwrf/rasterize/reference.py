"""Reference backend: the definition of the rasterizer in plain torch, against which the fast backends are tested.

    A(az, el) = sum_n weight_n exp(-1/2 |L_n^-1 d_n|^2),    d_n = (az - az_n wrapped to [-pi, pi], el - el_n)

These are the paper's equations of kernel and spectrum rasterization, with weight = delta psi. The exponent is evaluated in
whitened form, u = d_az / l1 and v = (d_el - l2 u) / l3, so that no determinant is formed and it is never positive.
"""

from __future__ import annotations

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid, wrap


def field(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> Tensor:
    """Return what `swiftwrf.rasterize` returns, on any device and in any dtype.

    Time and memory grow with N n_elevation n_azimuth for each position.
    """
    return torch.einsum("...nc,...nhw->...chw", weight, kernels(mean, cholesky, grid, cutoff))


def kernels(mean: Tensor, cholesky: Tensor, grid: AngularGrid, cutoff: float | None) -> Tensor:
    """Return the field of each primitive for a weight of 1, (..., N, n_elevation, n_azimuth).

    Args are those of `swiftwrf.rasterize`.
    """
    azimuth = grid.azimuth.to(mean)
    elevation = grid.elevation.to(mean)
    l1, l2, l3 = (c[..., None, None] for c in cholesky.unbind(-1))  # (..., N, 1, 1)
    u = wrap(azimuth - mean[..., 0, None, None]) / l1  # (..., N, 1, n_azimuth)
    v = (elevation[:, None] - mean[..., 1, None, None] - l2 * u) / l3  # (..., N, n_elevation, n_azimuth)
    kernel = torch.exp(-0.5 * (u * u + v * v))
    if cutoff is not None:
        kernel = torch.where(kernel >= cutoff, kernel, torch.zeros_like(kernel))
    return kernel
