"""Smooth functions of position that follow a Gaussian process, as a part of a model."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Self

import torch
from torch import Tensor, nn

from swiftwrf.gp.kernel import Kernel
from swiftwrf.gp.process import GaussianProcess
from swiftwrf.runtime.threads import single_thread


class SmoothField(nn.Module):
    """K smooth random functions of position, c(s) = k(s, Z) R^-T z with anchors Z and k(Z, Z) + noise = R R^T.

    Under the Gaussian-process prior z is standard normal, so that a small |z|^2 is a smooth function. Near the anchors the
    functions follow them; far from all of them they return to 0. With `value` the field is a regression and is not fitted by
    gradient descent.

    Args:
        anchor: Z, normalised positions (M, 3).
        kernel: k, on normalised positions.
        rank: K.
        whiten: R^-T (M, M) if it is known already.
        value: Noisy values (M, K) of a regression at the anchors.
        correlation: See `GaussianProcess`.

    Example:
        >>> position = torch.rand(20, 3)
        >>> field = SmoothField.regress(position, Kernel(noise=1e-3), position.sum(dim=1, keepdim=True))
        >>> field(position[:4]).shape, field.variance(position[:4]).shape
        (torch.Size([4, 1]), torch.Size([4]))
    """

    anchor: Tensor
    whiten: Tensor
    value: Tensor | None
    correlation: Tensor | None

    def __init__(
        self,
        anchor: Tensor,
        kernel: Kernel,
        rank: int,
        whiten: Tensor | None = None,
        value: Tensor | None = None,
        correlation: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.kernel = kernel
        self.register_buffer("anchor", anchor)
        self.register_buffer("value", None if value is None else value.to(anchor))
        self.register_buffer("correlation", correlation)
        if value is not None:
            return
        if whiten is None:  # in float64, because nearby anchors make the covariance nearly singular
            whiten = torch.linalg.inv(torch.linalg.cholesky(kernel.covariance(anchor))).T.to(anchor)
        self.register_buffer("whiten", whiten)
        self.coefficient = nn.Parameter(torch.zeros(len(anchor), rank))

    @classmethod
    @single_thread()
    def regress(
        cls, position: Tensor, kernel: Kernel, value: Tensor, process: GaussianProcess | None = None
    ) -> SmoothField:
        """Return the posterior mean of values (n, K) at normalised positions (n, 3), local among more than 2000.

        Args:
            position: Positions of the values.
            kernel: Kernel with its noise.
            value: Values.
            process: Process of these values, if it is known already.
        """
        correlation = process.correlation if process is not None and bool((process.correlation < 1).any()) else None
        field = cls(position, kernel, value.shape[1], value=value, correlation=correlation)
        field.process = process or field.process
        return field

    @cached_property
    def process(self) -> GaussianProcess:
        """Process of a regression, computed at first use on the device of the anchors."""
        assert self.value is not None
        return GaussianProcess.regress(self.kernel, self.anchor, self.value, correlation=self.correlation)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        before = self.anchor
        moved: Self = super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        if self.anchor is not before:
            self.__dict__.pop("process", None)
        return moved

    def variance(self, position: Tensor) -> Tensor:
        """Return the posterior variance of the functions at positions (B, 3), relative to k(0) = 1, (B,)."""
        if self.value is not None:
            return self.process.variance(position).to(position)
        known: Tensor = self.kernel(position, self.anchor) @ self.whiten
        return (1 - known.square().sum(dim=1)).clamp(0, 1)

    def forward(self, position: Tensor) -> Tensor:
        """Return c(s) at positions (B, 3), (B, K)."""
        if self.value is not None:
            return self.process.mean(position).to(position)
        return self.kernel(position, self.anchor) @ (self.whiten @ self.coefficient)

    def prior(self) -> Tensor:
        """Return |z|^2, the negative log prior up to a factor 1/2."""
        return self.coefficient.square().sum()
