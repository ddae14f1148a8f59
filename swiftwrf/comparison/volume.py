"""Signal of a ray through a medium that absorbs, shifts the phase and emits.

X. Zhao, Z. An, Q. Pan and L. Yang, "NeRF2: Neural Radio-Frequency Radiance Fields", ACM MobiCom 2023:

    S = sum_i a_i exp(j phi_i) g(r_(i+1)) prod_(k < i) exp(-alpha_k d_k) exp(j (1 + sum_(k < i) beta_k d_k))

with samples at distances r_i from the receiver, d_i = r_(i+1) - r_i, g(r) = 0.025 / r, absorption alpha [1/m], phase
change beta [rad/m], emitted amplitude a and phase phi. The last sample has no next one and contributes nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

PATH_GAIN = 0.025  # [m] amplitude times distance, from the publication's code
FIRST_PHASE = 1.0  # [rad], from the publication's code


class Medium(NamedTuple):
    """Properties of the medium at samples (..., S) along rays."""

    absorption: Tensor  # alpha [1/m], 0 or more
    turning: Tensor  # beta [rad/m]
    amplitude: Tensor  # a, 0 or more
    phase: Tensor  # phi [rad]


def integrate(medium: Medium, distance: Tensor) -> Tensor:
    """Return real and imaginary part of the signal of each ray, (2, ...).

    Args:
        medium: Medium at samples (..., S).
        distance: Distances of the samples from the receiver [m], ascending, (S,).
    """
    step = distance.diff()
    # the last sample neither attenuates another one nor emits
    absorption, turning, amplitude, phase = (value[..., :-1] for value in medium)
    depth, turned = absorption * step, turning * step
    before = torch.cumsum(depth, dim=-1) - depth
    arriving = amplitude * (PATH_GAIN / distance[1:]) * torch.exp(-before)
    angle = phase + FIRST_PHASE + torch.cumsum(turned, dim=-1) - turned
    return torch.stack([(arriving * torch.cos(angle)).sum(dim=-1), (arriving * torch.sin(angle)).sum(dim=-1)])
