"""The plain head, learnt step by step: primitives and motion together, by Adam on the same posterior as `solve`."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.errors import FitError
from swiftwrf.gp import Kernel
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.head import Head, pooled
from swiftwrf.rssi.law import HARMONICS
from swiftwrf.rssi.solve import Fitted, Group
from swiftwrf.runtime.threads import single_thread

JITTER = 1e-3  # of the motion's prior where sites nearly coincide
HELD_OUT = 0  # the one fold that is held out: a fit costs minutes


@single_thread()
def learn(group: Group, kernel: Kernel, config: RssiConfig, n_primitives: int, device: torch.device) -> Fitted:
    """Fits the receivers of a group twice: without one fold, and with all.

    Raises:
        FitError: a loss that is not finite.
    """
    covariance = kernel(group.local, group.local)
    covariance.diagonal().add_(JITTER)
    root = torch.linalg.cholesky(covariance)  # the motion at the sites is this times standard normal numbers
    out = group.fold == HELD_OUT
    partly = _descend(group, root.float(), ~out, n_primitives, config, device)[0]
    _, white, head = _descend(group, root.float(), torch.ones_like(out), n_primitives, config, device)
    white = white.double() * group.field_db
    zero = torch.zeros_like(group.law.level)
    return Fitted(
        level=group.law.level,
        slope=zero,
        directivity=torch.zeros(len(zero), HARMONICS, dtype=torch.float64),
        coefficient=torch.linalg.solve_triangular(root.T, white, upper=True),
        drawn=head.draw(),
        held_out=partly.double().where(out[:, None] & ~group.rssi.isnan(), torch.nan),
    )


def _descend(
    group: Group, root: Tensor, used: Tensor, n_primitives: int, config: RssiConfig, device: torch.device
) -> tuple[Tensor, Tensor, Head]:
    """Prediction at all sites (n, R) [dBm], the numbers behind the motion (n, R), and the head."""
    generator = torch.Generator().manual_seed(config.seed)
    head = Head(len(group.receiver), n_primitives, config.seed).to(device)
    white = nn.Parameter(torch.zeros(group.rssi.shape, device=device))
    level, deviation = group.law.level.float().to(device), group.field_db.float().to(device)
    measured, root = group.rssi.float().to(device), root.to(device)
    noise = (group.noise_db / group.count.clamp_min(1).sqrt()).float().to(device)
    rows = used.nonzero()[:, 0]
    heard = int((~group.rssi[rows].isnan()).sum())
    optimiser = torch.optim.Adam([*head.parameters(), white], lr=config.rate)

    def predict(at: Tensor) -> Tensor:
        return level + pooled(head.draw(), deviation * (root[at] @ white))

    for step in range(config.steps):
        batch = rows[torch.randint(len(rows), (min(config.batch, len(rows)),), generator=generator)].to(device)
        known = ~measured[batch].isnan()
        missed = ((predict(batch) - measured[batch]) / noise[batch])[known]
        loss = functional.huber_loss(missed, torch.zeros_like(missed), delta=config.huber, reduction="sum")
        loss = loss / max(len(missed), 1) + 0.5 * white.square().sum() / max(heard, 1)
        if not math.isfinite(loss.item()):
            raise FitError(
                f"the RSSI fit broke at step {step}: loss {loss.item():.3g}; try a rate below {config.rate:g}"
            )
        optimiser.zero_grad()
        loss.backward()
        optimiser.param_groups[0]["lr"] = config.rate * 0.5 * (1 + math.cos(math.pi * step / config.steps))
        optimiser.step()
    with torch.no_grad():
        predicted = torch.cat([predict(at) for at in torch.arange(len(root), device=device).split(config.batch)])
    return predicted.cpu(), white.detach().cpu(), head.requires_grad_(False).cpu()
