"""The paper's head: primitives and latent field of one receiver learnt together, by Adam on the posterior of `regression`."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.errors import FitError
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.head import Head, mean_magnitude
from swiftwrf.rssi.path_loss import N_HARMONICS
from swiftwrf.rssi.training import RssiTraining
from swiftwrf.runtime.threads import single_thread

PRIOR_JITTER = 1e-3  # relative variance added to the latent field, for bins that nearly coincide
HELD_OUT_FOLD = 0  # the only fold that is held out: a fit costs minutes


@single_thread()
def learn_receiver(data: RssiTraining, config: RssiConfig, device: torch.device) -> dict[str, Tensor]:
    """Fit one receiver twice: without one fold, and with all. Arguments and result as of `regression.fit_receiver`.

    Raises:
        FitError: A loss that is not finite.
    """
    covariance = data.kernel(data.position, data.position)
    covariance.diagonal().add_(PRIOR_JITTER)
    root = torch.linalg.cholesky(covariance)  # the latent field in the bins is this times standard normal numbers
    kept = data.fold != HELD_OUT_FOLD
    held_out = _descend(data, root.float(), kept, config, device)[0]
    _, white, head = _descend(data, root.float(), torch.ones_like(kept), config, device)
    field = data.field_db * torch.linalg.solve_triangular(root.T, white.double(), upper=True)
    return {
        "level": data.prior_mean.level[0],
        "slope": data.prior_mean.slope[0],
        "directivity": torch.zeros(N_HARMONICS, dtype=torch.float64),
        "coefficient": field[:, 0],
        "rendered": head.render(),
        "held_out": held_out[:, 0].double(),
    }


def _descend(
    data: RssiTraining, root: Tensor, kept: Tensor, config: RssiConfig, device: torch.device
) -> tuple[Tensor, Tensor, Head]:
    """Return the prediction in all bins (n, 1) [dBm], the standard normal numbers behind the field (n, 1), and the head."""
    generator = torch.Generator().manual_seed(config.seed)
    head = Head(data.receiver_names[0], data.n_primitives, config.seed).to(device)
    white = nn.Parameter(torch.zeros(data.rssi.shape, device=device))
    level, field_db = (x.float().to(device) for x in (data.prior_mean.level, data.field_db))
    measured, root = data.rssi.float().to(device), root.to(device)
    noise_db = (data.noise_db / data.count.clamp_min(1).sqrt()).float().to(device)
    rows = kept.nonzero()[:, 0]
    n_detected = int((~data.rssi[rows].isnan()).sum())
    optimiser = torch.optim.Adam([*head.parameters(), white], lr=config.rate)

    def predict(at: Tensor) -> Tensor:
        return level + mean_magnitude(head.render()[None], field_db * (root[at] @ white))

    for step in range(config.steps):
        batch = rows[torch.randint(len(rows), (min(config.batch, len(rows)),), generator=generator)].to(device)
        detected = ~measured[batch].isnan()
        error = ((predict(batch) - measured[batch]) / noise_db[batch])[detected]
        loss = functional.huber_loss(error, torch.zeros_like(error), delta=config.huber, reduction="sum")
        loss = loss / max(len(error), 1) + 0.5 * white.square().sum() / max(n_detected, 1)
        if not math.isfinite(loss.item()):
            raise FitError(
                f"the RSSI fit of receiver {data.receiver_names[0]!r} broke at step {step}: loss {loss.item():.3g}; "
                f"try a rate below {config.rate:g}"
            )
        optimiser.zero_grad()
        loss.backward()
        optimiser.param_groups[0]["lr"] = config.rate * 0.5 * (1 + math.cos(math.pi * step / config.steps))
        optimiser.step()
    with torch.no_grad():
        predicted = torch.cat([predict(at) for at in torch.arange(len(root), device=device).split(config.batch)])
    return predicted.cpu(), white.detach().cpu(), head.requires_grad_(False).cpu()
