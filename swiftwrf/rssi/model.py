"""RSSI from SwiftWRF: for each receiver a small spectrum that moves with the transmitter, averaged to one number.

    rssi_r(s) = T_r - 10 gamma_r log10 |s - receiver_r| + directivity_r(s) + 100 (pooled_r(s) - pooled_r)       [dBm]

pooled_r(s) is the magnitude of receiver r's primitives on a 16 x 16 grid, averaged over the grid; pooled_r that of the
canonical ones; 100 dB a unit is the scale of the NeRF2 data (rssi = 100 (a - 1)). The directivity is a few harmonics of the
direction from the receiver. Only the responses move, by smooth functions of position, so the field at any position is a
sum of a few fields, the same for all positions. All receivers of a group are one batched program.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.angles import AngularGrid
from swiftwrf.gp import Kernel, SmoothField
from swiftwrf.model.primitives import Primitives
from swiftwrf.positions import check_positions
from swiftwrf.rasterize import rasterize
from swiftwrf.rasterize.magnitude import magnitude
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.law import log_distance

GRID = AngularGrid.hemisphere(16, 16)
SCALE = 100.0  # dB per unit of pooled magnitude
UNCERTAINTY_ANCHORS = 400  # are enough to tell measured regions from others, at a tenth of the cost
DIRECTIVITY_DB = 2.0  # prior deviation of each harmonic of a receiver's antenna and surroundings
HARMONICS = 8  # real spherical harmonics of degree 1 and 2
JITTER = 1e-3  # of the field's prior where anchors nearly coincide


class ReceiverGroup(nn.Module):
    """Some receivers, fitted as one batched program.

    Args:
        receiver: positions (R, 3) [m].
        anchor: positions (M, 3) [m] of training rows.
        kernel: of the field's prior, lengths in [m]; its noise is that of the packets, relative to the field.
        n_primitives: a receiver; 0 leaves the log-distance law.
        config: rank, and what is learnt.
    """

    def __init__(self, receiver: Tensor, anchor: Tensor, kernel: Kernel, n_primitives: int, config: RssiConfig) -> None:
        super().__init__()
        n, rank = len(receiver), config.rank
        generator = torch.Generator().manual_seed(config.seed)
        self.rank, self.kernel, self.on_law = rank, kernel, config.law
        self.register_buffer("receiver", receiver.double())
        self.register_buffer("centre", anchor.double().mean(dim=0))
        self.register_buffer("field_db", torch.zeros(n))  # standard deviation of the field under its prior
        self.register_buffer("noise_db", torch.ones(n))  # of a packet about the field
        self.level = nn.Parameter(torch.zeros(n))  # T [dBm]
        self.slope = nn.Parameter(torch.zeros(n))  # -10 gamma [dB a decade]
        self.directivity = nn.Parameter(torch.zeros(n, HARMONICS))  # in units of its prior deviation
        local = (anchor.double() - self.centre).float()
        few = local[:: max(1, len(local) // UNCERTAINTY_ANCHORS)]
        self.register_buffer("few", few)
        gram = kernel(few.double(), few.double())
        precision = torch.linalg.inv(gram + kernel.noise * torch.eye(len(gram), dtype=gram.dtype))
        self.register_buffer("precision", precision.float())
        self.field = SmoothField(local, replace(kernel, noise=JITTER), n * rank)
        self.primitives = Primitives(n_primitives, GRID, generator=generator, scenes=(n,))
        self.basis = nn.Parameter(1 + 0.3 * torch.randn(n, rank, n_primitives, generator=generator))
        self.primitives.requires_grad_(config.learn_shapes)
        self.basis.requires_grad_(config.learn_shapes)
        for parameter in (self.level, self.slope, self.directivity):
            parameter.requires_grad_(config.law)

    receiver: Tensor
    centre: Tensor
    field_db: Tensor
    noise_db: Tensor
    few: Tensor
    precision: Tensor

    def harmonics(self, position: Tensor) -> Tensor:
        """Harmonics of degree 1 and 2 of the direction from each receiver, of unit mean square, (B, R, 8)."""
        x, y, z = functional.normalize(position[:, None] - self.receiver, dim=-1).float().unbind(-1)
        first = [math.sqrt(3) * c for c in (x, y, z)]
        second = [math.sqrt(15) * c for c in (x * y, y * z, z * x, (x * x - y * y) / 2)]
        return torch.stack([*first, *second, math.sqrt(5) / 2 * (3 * z * z - 1)], dim=-1)

    def prior(self) -> Tensor:
        """Negative log prior of the functions of position and of the directivity."""
        return 0.5 * (self.field.prior() + self.directivity.square().sum())

    def forward(self, position: Tensor) -> Tensor:
        """RSSI float32 (B, R) [dBm] at positions (B, 3) [m], float64."""
        law = self.level + self.slope * log_distance(position, self.receiver).float()
        law = law + DIRECTIVITY_DB * torch.einsum("brh,rh->br", self.harmonics(position), self.directivity)
        if not len(self.primitives):
            return law
        drawn = self._draw()  # (R, 1 + K, 2, pixels): the canonical field and the K that move it
        motion = self.field((position - self.centre).float()).reshape(len(position), -1, self.rank)
        moved = drawn[:, 0] + torch.einsum("brk,rkcp->brcp", motion, drawn[:, 1:])
        pooled = magnitude(moved[..., None]).mean(dim=(-2, -1))
        canonical = magnitude(drawn[:, 0, :, :, None]).mean(dim=(-2, -1)) if self.on_law else 1.0
        return law + SCALE * (pooled - canonical)

    def _draw(self) -> Tensor:
        """Canonical and basis fields, the latter scaled so that to first order RSSI has the prior's deviation."""
        mean, cholesky, attenuation, response = self.primitives()
        weight = attenuation[:, None, :, None] * torch.cat(
            [response[:, None], self.basis[..., None] * response[:, None]], dim=1
        )  # (R, 1 + K, N, 2)
        shape = weight.shape[:2]
        means, choleskys = (x[:, None].expand(*shape, -1, -1) for x in (mean, cholesky))
        drawn = rasterize(means, choleskys, weight, GRID).flatten(-2)
        canonical, basis = drawn[:, :1], drawn[:, 1:]
        phase = canonical / magnitude(canonical[..., None]).squeeze(-1).unsqueeze(-2).clamp_min(1e-6)
        gain = SCALE * (phase * basis).sum(dim=-2).mean(dim=-1)  # (R, K) dB for a unit of each function
        scale = self.field_db / gain.norm(dim=-1).clamp_min(1e-6)
        return torch.cat([canonical, scale[:, None, None, None] * basis], dim=1)

    def deviation(self, position: Tensor) -> Tensor:
        """Standard deviation of a measurement about the prediction, (B, R) [dB]: packet noise, and the field's
        uncertainty, which grows away from measured positions."""
        cross = self.kernel((position - self.centre).float(), self.few)
        unknown = (1 - (cross @ self.precision * cross).sum(dim=1)).clamp(0, 1)
        return (self.noise_db**2 + self.field_db**2 * unknown[:, None]).sqrt()


class RssiModel(nn.Module):
    """RSSI at R receivers for any position of the transmitter; what `fit_rssi` returns.

    Args:
        groups: of receivers, in their order.
    """

    def __init__(self, groups: Sequence[ReceiverGroup]) -> None:
        super().__init__()
        self.groups = nn.ModuleList(groups)
        self.register_buffer("widening", torch.ones(()))  # half of the interval in standard deviations

    widening: Tensor

    @property
    def n_primitives(self) -> int:
        """A receiver; 0 where the log-distance law is all."""
        return len(cast(ReceiverGroup, self.groups[0]).primitives)

    def forward(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """RSSI and the standard deviation of a measurement about it, (B, R) [dBm] and [dB], at positions (B, 3) [m]."""
        groups = [cast(ReceiverGroup, group) for group in self.groups]
        return tuple(torch.cat([f(position) for f in fs], dim=1) for fs in (groups, [g.deviation for g in groups]))  # type: ignore[return-value]

    @torch.no_grad()
    def predict(self, position: Tensor, batch: int = 2048) -> tuple[Tensor, Tensor, Tensor]:
        """RSSI at any positions, with an interval for a measurement there.

        Args:
            position: of the transmitter [m], (n, 3).
            batch: positions at a time, which bounds the memory.

        Returns:
            Prediction, lower and upper end of the interval, each float32 (n, R) [dBm].

        Raises:
            InputError: positions of another shape, or not finite.
        """
        position = check_positions(position)
        if not len(position):
            return (torch.empty(0, sum(len(cast(ReceiverGroup, group).receiver) for group in self.groups)),) * 3
        middle, deviation = (torch.cat(x) for x in zip(*(self(p) for p in position.split(batch)), strict=True))
        return middle, middle - self.widening * deviation, middle + self.widening * deviation
