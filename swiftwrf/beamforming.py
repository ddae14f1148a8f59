"""From what an array heard to power over directions: three beamformers.

All see the channel only through its covariance R = mean of h h^H over snapshots (subcarriers or packets of one position),
in units that put every spectrum into [0, 1]:

    phase:    S(k)^2 = a^H R a / K^2, with the phases of h alone (paper, equation of the spectrum, for one snapshot)
    bartlett: S(k)^2 = a^H R a / (K tr R), the share of the power that a beam towards k collects
    capon:    S(k)^2 ~ 1 / (a^H R^-1 a), the power of the beam that suppresses all else, its maximum put to 1
              (J. Capon, "High-resolution frequency-wavenumber spectrum analysis", Proc. IEEE 57, 1969)

a is the steering vector towards k and K the number of elements. Capon's level says little: paths that stay in step over the
snapshots cancel each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from swiftwrf.errors import InputError
from swiftwrf.registry import Registry

LOADING = 1e-2  # of Capon's covariance, relative to its mean diagonal: what is never heard must not divide by zero
AT_ONCE = 2**25  # complex numbers of beams in memory
PHASE = "phase"  # the beamformer of the paper

Beamformer = Callable[[Tensor, Tensor], Tensor]
BEAMFORMERS: Registry[Tensor] = Registry("beamformer")


def covariance(channel: Tensor) -> Tensor:
    """Mean of h h^H over the snapshots of each position, complex128 (n, K, K) of channels (n, S, K)."""
    channel = channel.to(torch.complex128)
    return channel.mT @ channel.conj() / channel.shape[1]


def _responses(roots: Tensor, steering: Tensor) -> Tensor:
    """sum_r |a^H f_r|^2 over rows f_r of roots (n, r, K) for steering vectors a (directions, K), float32 (n, directions)."""
    n, rank, _ = roots.shape
    adjoint = steering.conj().to(torch.complex64).T
    power = torch.empty(n, len(steering))
    for rows in torch.arange(n).split(max(1, AT_ONCE // (rank * len(steering)))):
        beams = roots[rows].to(torch.complex64) @ adjoint
        power[rows] = torch.view_as_real(beams).square().sum(dim=(1, 3))
    return power


def _roots(channel: Tensor) -> Tensor:
    """Fewer rows (n, r, K) with the covariance that channels (n, S, K) have."""
    if channel.shape[1] <= channel.shape[2]:
        return channel / math.sqrt(channel.shape[1])
    value, vector = torch.linalg.eigh(covariance(channel))
    roots: Tensor = (value.clamp_min(0).sqrt()[:, None, :] * vector).mT
    return roots


@BEAMFORMERS.register(PHASE, meaning="sum of phases, as the paper has it; power is ignored")
def phase(channel: Tensor, steering: Tensor) -> Tensor:
    """Squared spectra (n, directions) of the phases of channels (n, S, K)."""
    heard = torch.polar(torch.ones((), dtype=torch.float64), channel.angle().double())
    return _responses(_roots(heard), steering) / channel.shape[2] ** 2


@BEAMFORMERS.register("bartlett", meaning="share of the received power in a beam")
def bartlett(channel: Tensor, steering: Tensor) -> Tensor:
    """Squared spectra (n, directions) of channels (n, S, K)."""
    unit = channel.to(torch.complex128) / _size(channel)
    return _responses(_roots(unit), steering) / channel.shape[2] ** 2


@BEAMFORMERS.register(
    "capon", meaning="power of the beam that suppresses all else (minimum variance), relative to its maximum"
)
def capon(channel: Tensor, steering: Tensor) -> Tensor:
    """Squared spectra (n, directions) of channels (n, S, K).

    Raises:
        InputError: fewer snapshots than elements, whose covariance has no inverse.
    """
    if channel.shape[1] < channel.shape[2]:
        raise InputError(
            f"the capon beamformer needs at least as many snapshots (subcarriers or packets) as elements, got "
            f"{channel.shape[1]} of {channel.shape[2]} elements; use phase or bartlett"
        )
    unit = covariance(channel.to(torch.complex128) / _size(channel))
    lower = torch.linalg.cholesky(unit + LOADING * torch.eye(channel.shape[2], dtype=unit.dtype))
    whitened = torch.linalg.inv(lower).conj()
    power = 1 / _responses(whitened, steering)
    return power / power.amax(dim=1, keepdim=True)


def _size(channel: Tensor) -> Tensor:
    """Root mean square of an element's magnitude at each position, (n, 1, 1)."""
    return channel.abs().double().square().mean(dim=(1, 2), keepdim=True).sqrt().clamp_min(1e-300)
