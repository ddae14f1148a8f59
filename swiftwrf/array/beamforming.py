"""Beamformers: from the channel of an array to power over directions.

Each uses the covariance R = mean of h h^H over the snapshots (subcarriers or packets) of one position, and scales every
spectrum S into [0, 1]. With steering vector a(k) and K elements:

    phase:    S(k)^2 = a^H R a / (K tr R), R from the phases of h only (the paper's spectrum for one snapshot)
    bartlett: S(k)^2 = a^H R a / (K tr R), the fraction of the power that a beam towards k collects
    capon:    S(k)^2 ~ 1 / (a^H R^-1 a), scaled to a maximum of 1
              (J. Capon, "High-resolution frequency-wavenumber spectrum analysis", Proc. IEEE 57, 1969)

Capon's relative levels are not reliable if paths are coherent over the snapshots, because they cancel each other.

A beamformer is a function `(channel (n, S, K), responses) -> squared spectra`; `responses` computes a^H M a of Hermitian
matrices (n, K, K) at the directions of a grid.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from swiftwrf.errors import InputError

DIAGONAL_LOADING = 1e-2  # of Capon's covariance, relative to its mean diagonal, which keeps it invertible
PHASE = "phase"  # the beamformer of the paper

Responses = Callable[[Tensor], Tensor]


def covariance(channel: Tensor) -> Tensor:
    """Return the mean of h h^H over the snapshots of each position, complex128 (n, K, K), of channels (n, S, K)."""
    channel = channel.to(torch.complex128)
    return channel.mT @ channel.conj() / channel.shape[1]


def unit(channel: Tensor) -> Tensor:
    """Return a channel of any shape with all magnitudes 1, complex128. A missing value, 0, has no phase and stays 0."""
    channel = channel.to(torch.complex128)
    return channel / channel.abs().clamp_min(1e-300)


def unit_power(channel: Tensor) -> Tensor:
    """Return channels (n, S, K) of any scale with a mean power of 1 at each position. Zeros stay zeros.

    Example:
        >>> unit_power(torch.full((1, 1, 2), 3e-30j))
        tensor([[[0.+1.j, 0.+1.j]]])
    """
    wide = channel.to(torch.complex128)  # the square of a small single-precision number is 0
    power = wide.abs().square().mean(dim=(1, 2), keepdim=True)
    return (wide / power.sqrt().clamp_min(1e-300)).to(channel.dtype)


def unit_phasor(phase: Tensor) -> Tensor:
    """Return exp(j phase) for phases [rad] of any shape."""
    return torch.polar(torch.ones_like(phase), phase)


def phase(channel: Tensor, responses: Responses) -> Tensor:
    """Return squared spectra (n, ...) of the phases of channels (n, S, K)."""
    return responses(of_unit_power(unit(channel)) / channel.shape[2] ** 2)


def bartlett(channel: Tensor, responses: Responses) -> Tensor:
    """Return squared spectra (n, ...) of channels (n, S, K)."""
    return responses(of_unit_power(channel) / channel.shape[2] ** 2)


def capon(channel: Tensor, responses: Responses) -> Tensor:
    """Return squared spectra (n, ...) of channels (n, S, K).

    Raises:
        InputError: Fewer snapshots than elements, so that the covariance has no inverse.
    """
    if channel.shape[1] < channel.shape[2]:
        raise InputError(
            f"the capon beamformer needs at least as many snapshots (subcarriers or packets) as elements, got "
            f"{channel.shape[1]} of {channel.shape[2]} elements; use phase or bartlett"
        )
    power = 1 / responses(torch.linalg.inv(of_unit_power(channel) + DIAGONAL_LOADING * torch.eye(channel.shape[2])))
    return power / power.amax(dim=(1, 2), keepdim=True)


def of_unit_power(channel: Tensor) -> Tensor:
    """Return the covariance (n, K, K) of channels (n, S, K), scaled to a mean diagonal of 1."""
    found = covariance(channel)
    power = found.diagonal(dim1=1, dim2=2).real.mean(dim=1).clamp_min(1e-300)
    return found / power[:, None, None]


BEAMFORMERS = {PHASE: phase, "bartlett": bartlett, "capon": capon}
