"""Smooth functions of position that follow a Gaussian process, as a part of a model."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor, nn

from swiftwrf.gp import process
from swiftwrf.gp.kernel import Kernel
from swiftwrf.runtime.threads import single_thread


class SmoothField(nn.Module):
    """K smooth random functions of position, c(s) = k(s, Z) R^-T z with anchors Z and k(Z, Z) + noise = R R^T.

    Under the Gaussian-process prior z is standard normal, so that a small |z|^2 is a smooth function. Near the anchors the
    functions follow them; far from all of them they return to 0. With `value` the field is local and is not fitted by
    gradient descent: it interpolates from the nearest anchors only, for data sets too large for an exact solve.

    Args:
        anchor: Z, normalised positions (M, 3).
        kernel: k, on normalised positions.
        rank: K.
        whiten: R^-T (M, M) if it is known already.
        value: Values (M, K) of a local field at the anchors.
    """

    anchor: Tensor
    whiten: Tensor
    value: Tensor

    def __init__(
        self, anchor: Tensor, kernel: Kernel, rank: int, whiten: Tensor | None = None, value: Tensor | None = None
    ) -> None:
        super().__init__()
        self.kernel, self.local = kernel, value is not None
        self.register_buffer("anchor", anchor)
        if value is not None:
            self.register_buffer("value", value.to(anchor))
            return
        if whiten is None:  # in float64, because nearby anchors make the covariance nearly singular
            whiten = torch.linalg.inv(torch.linalg.cholesky(kernel.covariance(anchor))).T.to(anchor)
        self.register_buffer("whiten", whiten)
        self.coefficient = nn.Parameter(torch.zeros(len(anchor), rank))

    @classmethod
    @single_thread()
    def regress(cls, position: Tensor, kernel: Kernel, value: Tensor) -> SmoothField:
        """Return the posterior mean of values (n, K) at normalised positions (n, 3), local among more than 2000."""
        if len(position) > process.MAX_EXACT:
            return cls(position, kernel, value.shape[1], value=value)
        field = cls(position, kernel, value.shape[1])
        root = torch.linalg.cholesky(kernel.covariance(position))
        field.coefficient.data = torch.linalg.solve_triangular(root, value.double(), upper=False).to(position)
        return field

    @cached_property
    def _process(self) -> process.GaussianProcess:
        """Local process, built at first use, when the anchors are on their device."""
        return process.GaussianProcess(self.kernel, self.anchor, self.value, exact=False)

    def variance(self, position: Tensor) -> Tensor:
        """Return the posterior variance of the functions at positions (B, 3), relative to k(0) = 1, (B,)."""
        if self.local:
            return self._process.variance(position).to(position)
        known: Tensor = self.kernel(position, self.anchor) @ self.whiten
        return (1 - known.square().sum(dim=1)).clamp(0, 1)

    def forward(self, position: Tensor) -> Tensor:
        """Return c(s) at positions (B, 3), (B, K)."""
        if self.local:
            return self._process.mean(position).to(position)
        return self.kernel(position, self.anchor) @ (self.whiten @ self.coefficient)

    def prior(self) -> Tensor:
        """Return |z|^2, the negative log prior up to a factor 1/2."""
        return self.coefficient.square().sum()
