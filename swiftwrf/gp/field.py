"""Smooth functions of position that follow the process, as parts of a model."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from swiftwrf.gp.kernel import Kernel
from swiftwrf.gp.process import NearbyProcess
from swiftwrf.runtime.threads import single_thread


class SmoothField(nn.Module):
    """K smooth random functions of position, c(s) = k(s, Z) R^-T z with anchors Z and k(Z, Z) + noise = R R^T.

    Under the Gaussian-process prior z is standard normal, so that a small |z|^2 is a smooth function. Near the anchors the
    functions follow them; far from all of them they fall back to 0 instead of extrapolating.

    Args:
        anchor: Z, normalised positions (M, 3).
        kernel: k, on normalised positions.
        rank: K.
        whiten: R^-T (M, M) where it is known already.
    """

    def __init__(self, anchor: Tensor, kernel: Kernel, rank: int, whiten: Tensor | None = None) -> None:
        super().__init__()
        self.kernel = kernel
        self.register_buffer("anchor", anchor)
        if whiten is None:  # in float64, for nearby anchors are nearly alike
            whiten = torch.linalg.inv(torch.linalg.cholesky(kernel.noisy_gram(anchor))).T.to(anchor)
        self.register_buffer("whiten", whiten)
        self.coefficient = nn.Parameter(torch.zeros(len(anchor), rank))

    anchor: Tensor
    whiten: Tensor

    @classmethod
    @single_thread()
    def regress(cls, position: Tensor, kernel: Kernel, value: Tensor) -> SmoothField:
        """The functions that a Gaussian process tells from values (n, K) at normalised positions (n, 3)."""
        field = cls(position, kernel, value.shape[1])
        field.coefficient.data = torch.linalg.solve_triangular(
            torch.linalg.cholesky(kernel.noisy_gram(position)), value.double(), upper=False
        ).to(position)
        return field

    def variance(self, position: Tensor) -> Tensor:
        """Of the functions at positions (B, 3) once the measured spectra are known, relative to k(0) = 1, (B,)."""
        known: Tensor = self.kernel(position, self.anchor) @ self.whiten
        return (1 - known.square().sum(dim=1)).clamp(0, 1)

    def forward(self, position: Tensor) -> Tensor:
        """c(s) at positions (B, 3), (B, K)."""
        return self.kernel(position, self.anchor) @ (self.whiten @ self.coefficient)

    def prior(self) -> Tensor:
        """|z|^2, the negative log prior up to a factor 1/2."""
        return self.coefficient.square().sum()


class NearbyField(nn.Module):
    """What a smooth field tells of too many positions for one: its functions at a position from the values at the nearest
    ones alone.

    Args:
        anchor: normalised positions (M, 3).
        kernel: on normalised positions, with its noise.
        value: of K functions, (M, K).
    """

    def __init__(self, anchor: Tensor, kernel: Kernel, value: Tensor) -> None:
        super().__init__()
        self.kernel = kernel
        self.register_buffer("anchor", anchor)
        self.register_buffer("value", value.to(anchor))
        self._process: NearbyProcess | None = None

    anchor: Tensor
    value: Tensor

    @property
    def process(self) -> NearbyProcess:
        """Made at first use, when the anchors are where they stay."""
        if self._process is None or self._process.known.device != self.anchor.device:
            self._process = NearbyProcess(self.kernel, self.anchor)
        return self._process

    def variance(self, position: Tensor) -> Tensor:
        """Of the functions at positions (B, 3), relative to k(0) = 1, (B,)."""
        return self.process.variance(position).to(position)

    def forward(self, position: Tensor) -> Tensor:
        """The functions at positions (B, 3), (B, K)."""
        return self.process.mean(position, self.value).to(position)
