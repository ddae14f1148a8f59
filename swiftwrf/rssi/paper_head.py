"""The paper's head: primitives and latent field learnt together, by Adam on the posterior of `swiftwrf.rssi.regression`."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.errors import FitError
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.head import Head, mean_magnitude, render
from swiftwrf.rssi.path_loss import N_HARMONICS
from swiftwrf.rssi.training import RssiTraining
from swiftwrf.runtime.threads import single_thread

PRIOR_JITTER = 1e-3  # relative variance added to the latent field, for bins that nearly coincide
HELD_OUT_FOLD = 0  # the only fold that is held out: a fit costs minutes


@single_thread()
def learn_receivers(some: slice, data: RssiTraining, config: RssiConfig, device: torch.device) -> dict[str, Tensor]:
    """Fit some receivers twice: without one fold, and with all. Arguments and result as of `regression.fit_receiver`.

    The receivers share the steps, which saves time, but no parameter, loss or moment: each is fitted as if alone.

    Raises:
        FitError: A loss that is not finite.
    """
    covariance = data.kernel(data.position, data.position)
    covariance.diagonal().add_(PRIOR_JITTER)
    root = torch.linalg.cholesky(covariance)  # the latent field in the bins is this times standard normal numbers
    kept = data.fold != HELD_OUT_FOLD
    held_out = _descend(some, data, root.float(), kept, config, device)[0]
    _, white, rendered = _descend(some, data, root.float(), torch.ones_like(kept), config, device)
    return {
        "level": data.prior_mean.level[some],
        "slope": data.prior_mean.slope[some],
        "slope_std": torch.zeros(len(rendered), dtype=torch.float64),
        "directivity": torch.zeros(len(rendered), N_HARMONICS, dtype=torch.float64),
        "coefficient": torch.linalg.solve_triangular(root.T, white.double() * data.field_db[some], upper=True).T,
        "rendered": rendered,
        "held_out": held_out.double().T,
    }


def _descend(
    some: slice, data: RssiTraining, root: Tensor, kept: Tensor, config: RssiConfig, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """Return predictions in all bins (n, R) [dBm], the normal numbers behind the field (n, R), and the rendered heads."""
    generator = torch.Generator().manual_seed(config.seed)
    names = data.receiver_names[some]
    heads = [Head(name, data.n_primitives, config.seed).to(device) for name in names]
    level, field_db = (x[some].float().to(device) for x in (data.prior_mean.level, data.field_db))
    measured, root = data.rssi[:, some].float().to(device), root.to(device)
    white = nn.Parameter(torch.zeros_like(measured))
    noise_db = (data.noise_db / data.count.clamp_min(1).sqrt())[:, some].float().to(device)
    rows = kept.nonzero()[:, 0]
    n_detected = (~measured[rows.to(device)].isnan()).sum(dim=0).clamp_min(1)
    optimiser = torch.optim.Adam([*(p for head in heads for p in head.parameters()), white], lr=config.rate)

    def predict(at: Tensor) -> Tensor:
        return level + mean_magnitude(render(heads), field_db * (root[at] @ white))

    for step in range(config.steps):
        batch = rows[torch.randint(len(rows), (min(config.batch, len(rows)),), generator=generator)].to(device)
        detected = ~measured[batch].isnan()
        error = ((predict(batch) - measured[batch]) / noise_db[batch]).where(detected, 0.0)
        losses = functional.huber_loss(error, torch.zeros_like(error), delta=config.huber, reduction="none").sum(dim=0)
        losses = losses / detected.sum(dim=0).clamp_min(1) + 0.5 * white.square().sum(dim=0) / n_detected
        loss = losses.sum()
        if not math.isfinite(loss.item()):
            raise FitError(
                f"the RSSI fit of {', '.join(names)} broke at step {step}: loss {loss.item():.3g}; try a rate "
                f"below {config.rate:g}"
            )
        optimiser.zero_grad()
        loss.backward()
        optimiser.param_groups[0]["lr"] = config.rate * 0.5 * (1 + math.cos(math.pi * step / config.steps))
        optimiser.step()
    with torch.no_grad():
        parts = torch.arange(len(root), device=device).split(config.batch)
        return torch.cat([predict(at) for at in parts]).cpu(), white.detach().cpu(), render(heads).cpu()
