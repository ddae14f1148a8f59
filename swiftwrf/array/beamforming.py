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

from collections.abc import Callable

import torch
from torch import Tensor

from swiftwrf.errors import InputError
from swiftwrf.runtime.registry import Registry

LOADING = 1e-2  # of Capon's covariance, relative to its mean diagonal: what is never heard must not divide by zero
PHASE = "phase"  # the beamformer of the paper

Responses = Callable[[Tensor], Tensor]  # a^H M a of Hermitian matrices (n, K, K) at the directions of a grid, (n, ...)
BEAMFORMERS: Registry[Tensor] = Registry("beamformer")


def covariance(channel: Tensor) -> Tensor:
    """Mean of h h^H over the snapshots of each position, complex128 (n, K, K) of channels (n, S, K)."""
    channel = channel.to(torch.complex128)
    return channel.mT @ channel.conj() / channel.shape[1]


@BEAMFORMERS.register(PHASE)
def phase(channel: Tensor, responses: Responses) -> Tensor:
    """Squared spectra (n, ...) of the phases of channels (n, S, K)."""
    heard = torch.polar(torch.ones((), dtype=torch.float64), channel.angle().double())
    return responses(covariance(heard) / channel.shape[2] ** 2)


@BEAMFORMERS.register("bartlett")
def bartlett(channel: Tensor, responses: Responses) -> Tensor:
    """Squared spectra (n, ...) of channels (n, S, K)."""
    return responses(_of_unit_power(channel) / channel.shape[2] ** 2)


@BEAMFORMERS.register("capon")
def capon(channel: Tensor, responses: Responses) -> Tensor:
    """Squared spectra (n, ...) of channels (n, S, K).

    Raises:
        InputError: fewer snapshots than elements, whose covariance has no inverse.
    """
    if channel.shape[1] < channel.shape[2]:
        raise InputError(
            f"the capon beamformer needs at least as many snapshots (subcarriers or packets) as elements, got "
            f"{channel.shape[1]} of {channel.shape[2]} elements; use phase or bartlett"
        )
    power = 1 / responses(torch.linalg.inv(_of_unit_power(channel) + LOADING * torch.eye(channel.shape[2])))
    return power / power.amax(dim=(1, 2), keepdim=True)


def _of_unit_power(channel: Tensor) -> Tensor:
    """Covariance (n, K, K) with a mean diagonal of 1."""
    found = covariance(channel)
    power = found.diagonal(dim1=1, dim2=2).real.mean(dim=1).clamp_min(1e-300)
    return found / power[:, None, None]
