"""The RSSI model of the paper: primitives and latent field of each receiver, learnt together by gradient descent.

    rssi_r(s) = -100 + m_r(c_r(s))       [dBm]

m_r is the mean magnitude of the receiver's primitives (`swiftwrf.rssi.head`), and c_r a Gaussian process of the position.
There is no path-loss model. The loss is that of `swiftwrf.rssi.regression`.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.data.rssi import Rssi
from swiftwrf.errors import FitError, InputError
from swiftwrf.models.base import CPU
from swiftwrf.rssi.base import Map, columns_of, often_detected
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.head import Head, Heads, mean_magnitude, render
from swiftwrf.rssi.model import RssiModel
from swiftwrf.rssi.posterior import RssiPosterior, held_out_std
from swiftwrf.rssi.training import Bins, check_folds, choose_residual_kernels, prior_std
from swiftwrf.runtime.progress import progress_bar
from swiftwrf.runtime.threads import single_thread
from swiftwrf.runtime.validation import PositiveFloat, PositiveInt, configuration

LEVEL_DBM = -100.0  # where nothing is received. The paper leaves the scale of its target open: this is that of NeRF2
HELD_OUT_FOLD = 0  # the only fold that is held out: a fit costs minutes


@configuration
class RssiPaperConfig(RssiConfig):
    """Options of `RssiPaperModel`."""

    steps: PositiveInt = 600
    """gradient steps"""
    batch: PositiveInt = 1024
    """location bins a gradient step"""
    rate: PositiveFloat = 5e-2
    """learning rate of a gradient step"""


class RssiPaperModel(RssiModel):
    """RSSI by the paper's head: 50 learnt primitives a receiver on 16 x 16 directions, and their mean magnitude only.

    It cannot be updated. One of five folds is held out to calibrate the standard deviation.

    The options are those of `RssiPaperConfig`.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.rssi_room(n=60).split()
        >>> RssiPaperModel(steps=5).fit(train).predict(test.transmitter_position).mean.shape
        torch.Size([12, 12])
    """

    kind = "rssi paper model"
    name = "swiftwrf_paper"
    config_type = RssiPaperConfig
    slow, updates = True, False

    def _fit(
        self,
        train: Rssi,
        *,
        pool: Rssi,
        device: torch.device = CPU,
        parallel: Map | None = None,
        progress: bool = False,
        **_: Any,
    ) -> None:
        config, of_pool = self.config, Bins.of(pool, self.config)
        bins = of_pool.columns(columns_of(train.receiver_names, pool))
        check_folds(bins.fold == HELD_OUT_FOLD, bins.rssi)
        pool_residual = of_pool.rssi - of_pool.rssi.nanmean(dim=0)
        residual = pool_residual[:, often_detected(pool), None]
        kernel = choose_residual_kernels(bins, residual, config.noises, train.floors is not None)[0][0]
        variance = (bins.rssi - bins.rssi.nanmean(dim=0)).square().nanmean(dim=0)
        variance = variance.nan_to_num(float(pool_residual.square().nanmean())).clamp_min(1e-6)
        prior_db = prior_std(variance, kernel, bins.noise_scale)
        covariance = kernel(bins.position, bins.position)
        covariance.diagonal().add_(1e-3)  # bins may nearly coincide
        root = torch.linalg.cholesky(covariance)  # the latent field in the bins is this times standard normal numbers
        task = partial(learn_receivers, bins=bins, root=root, prior_db=prior_db, config=config, device=device)
        n_receivers = len(bins.receiver_names)
        parts = [slice(start, start + 4) for start in range(0, n_receivers, 4)]
        with progress_bar(progress) as bar:
            # compiled rasterizers are not safe in several threads
            fits = (parallel or map)(task, parts)
            results = list(bar.track(fits, total=len(parts), description="receivers"))
        held_out, white, rendered = (torch.cat(values) for values in zip(*results, strict=True))
        self.covariance, self.centre, self.detection_field = torch.zeros(n_receivers, 2, 2).double(), bins.centre, None
        out = ~bins.rssi.isnan() & (bins.fold == HELD_OUT_FOLD)[:, None]
        predicted = held_out.T.double().where(out, torch.nan)[bins.bin_of_row]
        std = held_out_std(bins, bins.fold, kernel, prior_db, self.covariance)[bins.bin_of_row]
        self._calibrate(train, predicted, std, *prior_db)
        dual = torch.linalg.solve_triangular(root.T, white.T.double() * prior_db[0], upper=True).T
        level = LEVEL_DBM + mean_magnitude(rendered, torch.zeros(1, n_receivers))[0].double()
        # the dual coefficients are those of the kernel alone, without a path loss or noise
        self.posterior = RssiPosterior(
            kernel=kernel,
            heads=Heads(rendered),
            huber=config.huber,
            receiver=bins.receiver,
            position=bins.position,
            dual=dual,
            tangent=torch.ones_like(dual),
            variance=torch.zeros_like(dual),
            measured=torch.ones_like(dual),
            prior=torch.stack([level, torch.zeros_like(level)], dim=1),
            root=torch.zeros_like(self.covariance),
            field_db=torch.ones_like(level),
            noise_db=torch.zeros_like(level),
        )

    def _restored(self) -> None:
        super()._restored()
        if len(self.posterior.heads.rendered) != len(self.receiver_names):
            raise InputError("each receiver needs its head")


@single_thread()
def learn_receivers(
    part: slice,
    bins: Bins,
    root: Tensor,
    prior_db: tuple[Tensor, Tensor],
    config: RssiPaperConfig,
    device: torch.device,
) -> tuple[Tensor, Tensor, Tensor]:
    """Fit the receivers of a part twice: without one fold, and with all.

    The receivers share the steps, which saves time, but no parameter, loss or moment: each is fitted as if alone. `root` is
    the Cholesky factor of the covariance of the latent field in the n bins, (n, n), and `prior_db` are the standard
    deviations of latent field and noise, each (R,) [dB].

    Returns:
        Predictions of the fit without the fold (R, n) [dBm], the standard normal numbers behind the field (R, n), and the
        rendered heads (R, 2, 2, directions).

    Raises:
        FitError: A loss that is not finite.
    """
    names, root = bins.receiver_names[part], root.float().to(device)
    field_db, noise_db = (x[part].float().to(device) for x in prior_db)
    measured, count = (x[:, part].float().to(device) for x in (bins.rssi, bins.count))
    noise_db = noise_db / count.clamp_min(1).sqrt()

    def descend(rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return predictions in all bins (R, n) by the fit to the bins `rows`, the normal numbers (R, n), and the heads."""
        generator = torch.Generator().manual_seed(config.seed)
        heads = [Head(config.n_primitives, config.seed).to(device) for _ in names]
        white = nn.Parameter(torch.zeros_like(measured))
        n_detected = (~measured[rows.to(device)].isnan()).sum(dim=0).clamp_min(1)
        optimiser = torch.optim.Adam([*(p for head in heads for p in head.parameters()), white], lr=config.rate)

        def predict(at: Tensor) -> Tensor:
            return LEVEL_DBM + mean_magnitude(render(heads), field_db * (root[at] @ white))

        for step in range(config.steps):
            batch = rows[torch.randint(len(rows), (min(config.batch, len(rows)),), generator=generator)].to(device)
            detected = ~measured[batch].isnan()
            error = ((predict(batch) - measured[batch]) / noise_db[batch]).where(detected, 0.0)
            losses = functional.huber_loss(error, torch.zeros_like(error), delta=config.huber, reduction="none")
            losses = losses.sum(dim=0) / detected.sum(dim=0).clamp_min(1)
            loss = (losses + 0.5 * white.square().sum(dim=0) / n_detected).sum()
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
            return torch.cat([predict(at) for at in parts]).cpu().T, white.detach().cpu().T, render(heads).cpu()

    held_out = descend((bins.fold != HELD_OUT_FOLD).nonzero()[:, 0])[0]
    return held_out, *descend(torch.arange(len(bins.fold)))[1:]
