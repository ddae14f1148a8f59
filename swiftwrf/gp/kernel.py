"""The kernel of the process, and the candidates that data choose among."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from scipy.optimize import brentq
from torch import Tensor

from swiftwrf.errors import InputError
from swiftwrf.positions import distance


@dataclass(frozen=True)
class Kernel:
    """Covariance of a field at two positions by their distance r: a rough long-range and a smooth short-range part.

        k(r) = share exp(-r / long) + (1 - share) (1 + sqrt(3) r / short) exp(-sqrt(3) r / short)

    The long part (Matern 1/2) models a rough field between positions that are wavelengths apart, the short one (Matern 3/2)
    a path that is sampled densely.

    Args:
        long: Correlation length of the rough part, in the unit of the positions.
        short: Correlation length of the smooth part.
        share: Variance of the rough part, in [0, 1].
        noise: Variance that does not depend on position, relative to k(0) = 1.
        vertical: Factor of differences in z, e.g. between floors.

    Raises:
        InputError: A value outside its range.

    Example:
        >>> Kernel(long=1.0, share=1.0)(torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0]]))
        tensor([[0.3679]])
    """

    long: float = 0.5
    short: float = 0.1
    share: float = 0.6
    noise: float = 1e-2
    vertical: float = 1.0

    def __post_init__(self) -> None:
        finite = all(map(math.isfinite, (self.long, self.short, self.share, self.noise, self.vertical)))
        positive = min(self.long, self.short, self.vertical) > 0
        if not (finite and positive and 0 <= self.share <= 1 and self.noise >= 0):
            raise InputError(
                f"a kernel needs lengths and a vertical factor above 0, a share in [0, 1] and a noise from 0, got {self}"
            )

    @property
    def correlation_length(self) -> float:
        """Distance at which the covariance has fallen to 1/e, in the unit of the positions."""
        longest = max(self.long, self.short)
        return float(brentq(lambda r: float(self.at(torch.tensor(r).double())) - 1 / math.e, 0.0, 2 * longest))

    def scaled(self, factor: float) -> Kernel:
        """Return the equivalent kernel for positions that are multiplied by `factor`."""
        return replace(self, long=self.long * factor, short=self.short * factor)

    def __call__(self, a: Tensor, b: Tensor) -> Tensor:
        """Return k between positions (n, 3) and (m, 3), (n, m)."""
        if self.vertical != 1:
            scale = a.new_tensor([1.0, 1.0, self.vertical])
            a, b = a * scale, b * scale
        return self.at(distance(a, b))

    def at(self, r: Tensor) -> Tensor:
        """Return k at distances of any shape."""
        if self.share == 1:
            return torch.exp(-r / self.long)
        near = math.sqrt(3) * r / self.short
        value: Tensor = self.share * torch.exp(-r / self.long) + (1 - self.share) * (1 + near) * torch.exp(-near)
        return value

    def covariance(self, position: Tensor) -> Tensor:
        """Return the covariance of noisy values at positions (n, 3), float64 (n, n)."""
        position = position.double()
        noisy: Tensor = self(position, position) + self.noise * torch.eye(len(position)).to(position)
        return noisy


def candidates(position: Tensor, noises: Sequence[float]) -> Iterator[Kernel]:
    """Yield kernels with lengths from the extent of the positions (n, 3) [m] down, with and without a smooth part.

    Example:
        >>> kernels = list(candidates(torch.rand(50, 3, dtype=torch.float64), noises=[0.01]))
        >>> {kernel.noise for kernel in kernels}
        {0.01}
    """
    extent = float((position.max(0).values - position.min(0).values).max()) or 1.0
    for noise in noises:
        for k in range(5):
            long = extent / 2**k
            yield Kernel(long=long, short=extent, share=1.0, noise=noise)
            yield from (Kernel(long=long, short=extent / 3 / 2**j, share=0.6, noise=noise) for j in range(1, 6))
