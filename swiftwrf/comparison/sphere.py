"""Projection of 3D Gaussians onto the sphere of an array's directions: 2D Gaussians in azimuth and elevation.

The first-order image of a Gaussian of covariance S under the map f from a point to its direction is one of covariance
J S J^T about f(mean), J = df (M. Zwicker, H. Pfister, J. van Baar and M. Gross, "EWA splatting", IEEE TVCG 8(3), 2002, there
for a camera). With rho = |(x, y)| and r = |(x, y, z)|

    d azimuth = (-y, x, 0) / rho^2,    d elevation = (-x |z|, -y |z|, sign(z) rho^2) / (rho r^2)

because a planar array cannot distinguish z from -z and folds the half space behind it. At the pole d azimuth diverges: a
Gaussian there is flat over all azimuths, which are one direction at an elevation of 90 degrees.
"""

from __future__ import annotations

import torch
from torch import Tensor

from swiftwrf.array.angles import to_angles
from swiftwrf.models.primitives import MAX_WIDTH_RAD

MIN_AXIS_DISTANCE = 1e-6  # relative to the distance; limits d azimuth near the axis


def on_sphere(mean: Tensor, factor: Tensor, blur: Tensor) -> tuple[Tensor, Tensor]:
    """Return means (..., N, 2) and Cholesky factors (..., N, 3) [rad] for `swiftwrf.rasterize`.

    Args:
        mean: Means of the Gaussians in array coordinates, relative to the array, (..., N, 3), not 0.
        factor: F with covariance F F^T in array coordinates, (N, 3, 3).
        blur: Standard deviations in azimuth and elevation [rad], (2,), that are added in quadrature, so that no Gaussian
            falls between pixels.
    """
    x, y, z = mean.unbind(-1)
    r, flat = mean.norm(dim=-1), torch.hypot(x, y)
    rho = torch.maximum(flat, MIN_AXIS_DISTANCE * r)
    cosine = torch.where(flat > 0, x / rho, torch.ones_like(x))  # at the pole the azimuth is arbitrary
    sine, up = y / rho, torch.where(z < 0, -1.0, 1.0)
    turn = torch.stack([-sine, cosine, torch.zeros_like(z)], dim=-1) / rho[..., None]
    rise = torch.stack([-cosine * z.abs(), -sine * z.abs(), up * flat], dim=-1) / r.square()[..., None]
    image = torch.einsum("...nak,nkl->...nal", torch.stack([turn, rise], dim=-2), factor)
    variance = image.square().sum(dim=-1) + blur.square()
    shrink = torch.rsqrt(1 + variance / MAX_WIDTH_RAD**2)  # limits the width, which would overflow
    l1 = variance[..., 0].sqrt() * shrink[..., 0]
    l2 = (image[..., 0, :] * image[..., 1, :]).sum(dim=-1) * shrink.prod(dim=-1) / l1
    # positive because of the blur, except for rounding
    l3 = (variance[..., 1] * shrink[..., 1].square() - l2.square()).clamp_min((blur[1] * 0.5).square()).sqrt()
    return torch.stack(to_angles(mean), dim=-1), torch.stack([l1, l2, l3], dim=-1)
