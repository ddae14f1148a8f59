"""Positions as networks are given them."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def encode(x: Tensor, bands: int, lowest: float = math.pi) -> Tensor:
    """[x, sin(2^k lowest x), cos(2^k lowest x)], k = 0 .. bands - 1: (..., d) to (..., d (2 bands + 1)).

    The paper takes pi for the lowest frequency, on numbers in [-1, 1]; NeRF2 takes 1, on metres.
    """
    angle = x[..., None, :] * (lowest * 2.0 ** torch.arange(bands, dtype=x.dtype, device=x.device))[:, None]
    return torch.cat([x, torch.sin(angle).flatten(-2), torch.cos(angle).flatten(-2)], dim=-1)
