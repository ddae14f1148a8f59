"""From measured RSSI to a model."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import MIN_TRAINING, folds
from swiftwrf.errors import FitError, InputError
from swiftwrf.gp import Kernel, candidates, held_out_weights, thinned
from swiftwrf.progress import progress
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.law import Law, fit_law, log_distance
from swiftwrf.rssi.model import ReceiverGroup, RssiModel

MAX_ANCHORS = 1500
GROUP = 16  # receivers fitted as one program: bounds the memory of hundreds
NOISES = (0.3, 1.0, 2.0, 3.0)  # variance of a packet relative to that of the field: fading is as large as shadowing
Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]


def fit_rssi(
    train: Rssi, config: RssiConfig | None = None, *, device: torch.device | str = "cpu", parallel: Map = map
) -> RssiModel:
    """Fits all receivers at once; same data, configuration and machine give the same model.

    The kernel, and whether there are primitives at all, are chosen by cross-validation on what the log-distance law leaves;
    the width of the interval on one held-out fold of the training rows.

    Args:
        train: the only rows it sees; a receiver's missing values do not count.
        config: how; `RssiConfig()` unless given.
        device: where to optimise; the model that comes back is on the CPU.
        parallel: maps the fit over groups of receivers; give one that spreads work over processes or machines.

    Raises:
        InputError: a receiver heard in too few rows.
        FitError: a loss that is not finite.
    """
    config = config or RssiConfig()
    for name, count in zip(train.receiver_names, (~train.rssi_dbm.isnan()).sum(dim=0).tolist(), strict=True):
        if count < MIN_TRAINING:
            raise InputError(f"receiver {name!r} is heard in {count} training rows; at least {MIN_TRAINING} are needed")
    fold = folds(train.transmitter_position, config.validation, config.seed)
    kernel, helps = _choose_field(train.transmitter_position, _law(train)[1], fold)
    rest, held_out = train.subset((fold != 0).nonzero()[:, 0]), train.subset((fold == 0).nonzero()[:, 0])
    task = functools.partial(
        _optimise,
        n_primitives=config.n_primitives if helps or not config.law else 0,
        kernel=kernel,
        config=config,
        device=torch.device(device),
    )
    searched, model = (RssiModel(list(parallel(task, _groups(rows)))) for rows in (rest, train))
    with torch.no_grad():
        predicted, deviation = searched(held_out.transmitter_position)
    standardised = (predicted - held_out.rssi_dbm).abs() / deviation
    model.widening.fill_(standardised[standardised.isfinite()].quantile(config.coverage))
    return model.eval()


def _groups(rows: Rssi) -> list[Rssi]:
    """The receivers in groups of a fixed size, so that the numbers do not depend on who fits which group."""
    columns = list(range(len(rows.receiver_names)))
    return [rows.columns(columns[start : start + GROUP]) for start in range(0, len(columns), GROUP)]


def _choose_field(position: Tensor, residual: Tensor, fold: Tensor) -> tuple[Kernel, bool]:
    """The kernel that best predicts what the log-distance law leaves (n, R) where it is held out, by mean absolute error
    [dB], and whether that is better than leaving it. Missing values count as 0 when they predict; they are not scored."""
    position, residual, fold = thinned(position, residual, fold)
    filled = residual.nan_to_num()

    def missed(kernel: Kernel) -> float:
        parts = held_out_weights(kernel, position, fold)
        return float(torch.cat([(gain @ filled[kept] - residual[out]).abs() for out, kept, gain in parts]).nanmean())

    best = min(candidates(position, NOISES), key=missed)
    return best, missed(best) < float(residual.abs().nanmean())


def _law(train: Rssi) -> tuple[Law, Tensor]:
    """The law of each receiver, and what it leaves (n, R), nan where not heard."""
    distance = log_distance(train.transmitter_position, train.receiver_position)
    law = fit_law(distance, train.rssi_dbm)
    return law, train.rssi_dbm - law(distance)


def _optimise(
    train: Rssi, n_primitives: int, kernel: Kernel, config: RssiConfig, device: torch.device
) -> ReceiverGroup:
    """Maximum a posteriori: Huber's loss in units of the noise, and the prior of the functions of position."""
    generator = torch.Generator().manual_seed(config.seed)
    position, rssi = train.transmitter_position, train.rssi_dbm.float()
    rows = torch.randperm(len(train), generator=generator)[:MAX_ANCHORS].sort().values
    model = ReceiverGroup(train.receiver_position, position[rows], kernel, n_primitives, config)
    law, residual = _law(train)
    variance = residual.square().nanmean(dim=0).float().clamp_min(1e-6)
    with torch.no_grad():
        if config.law:
            model.level.copy_(law.level)
            model.slope.copy_(law.slope)
        share = kernel.noise / (1 + kernel.noise) if n_primitives else 1.0
        model.noise_db.copy_((share * variance).sqrt())
        model.field_db.copy_(((1 - share) * variance).sqrt())
    model, position, rssi = model.to(device), position.to(device), rssi.to(device)
    optimiser = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], lr=config.rate)
    heard = int((~rssi.isnan()).sum())
    described = f"{len(train.receiver_names)} receivers, {n_primitives} primitives"
    for step in progress(range(config.steps), described):
        batch = torch.randint(len(train), (min(config.batch, len(train)),), generator=generator)
        measured = rssi[batch]
        missed = ((model(position[batch]) - measured) / model.noise_db)[~measured.isnan()]
        loss = functional.huber_loss(missed, torch.zeros_like(missed), delta=config.huber)
        loss = loss + model.prior() / heard
        if not math.isfinite(loss.item()):
            raise FitError(
                f"the RSSI fit broke at step {step}: loss {loss.item():.3g}; try a rate below {config.rate:g}"
            )
        optimiser.zero_grad()
        loss.backward()
        optimiser.param_groups[0]["lr"] = config.rate * 0.5 * (1 + math.cos(math.pi * step / config.steps))
        optimiser.step()
    return model.requires_grad_(False).cpu()
