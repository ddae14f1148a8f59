"""The training rows of an RSSI fit by location bin, with the priors of every receiver and the kernel of all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import MIN_TRAINING, folds
from swiftwrf.gp import Kernel, candidates, held_out_errors, subsample
from swiftwrf.positions import cells
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.head import Head, render
from swiftwrf.rssi.path_loss import PathLoss, fit_path_loss, fit_shared_path_loss, log_distance
from swiftwrf.runtime.threads import single_thread

MAX_STEP_DB = 1.0  # of the values that a receiver reports: nearly all report whole decibels
PAPER_LEVEL_DBM = -100.0  # of the paper's head where nothing is received
# variance of a packet relative to the variance of the field: fading is as large as shadowing
RELATIVE_NOISE_VARIANCES = (0.3, 1.0, 2.0, 3.0)
VERTICALS = (1.0, 5.0)  # factors of the heights of floors: floors alike, or nearly independent beyond their attenuation
MAX_KERNEL_ROWS, MAX_KERNEL_RECEIVERS = 300, 12  # more do not change the chosen kernel or weights


@dataclass(frozen=True)
class RssiTraining:
    """Training rows averaged by location bin, and everything that is known before a receiver is fitted.

    Args:
        receiver_names: R names.
        receiver: Positions less the centre, float64 (R, 3) [m], nan where unknown.
        centre: Mean of the bins' positions, float64 (3,) [m].
        position: Mean position in each bin less the centre, float64 (n, 3) [m].
        bin_of_row: Bin of each training row, int64 (rows,).
        fold: Cross-validation fold of each bin, int64 (n,).
        rssi: Mean in each bin, float64 (n, R) [dBm], nan where not detected.
        count: Measurements in each mean, float64 (n, R).
        kernel: Kernel of the latent field, lengths in [m].
        rendered: Fields of each receiver's head, (R, 2, 2, directions).
        prior_mean: Path-loss model of each receiver that its fit starts from, (R,).
        field_db: Prior standard deviation of the latent field, (R,) [dB].
        noise_db: Standard deviation of one measurement about it, (R,) [dB].
        baselines: Path-loss models of the simple predictors, (3, R): that of each receiver, that of all receivers, and the
            mean of each receiver.
        baseline_held_out: Their predictions of held-out bins, (3, n, R) [dBm].
    """

    receiver_names: tuple[str, ...]
    receiver: Tensor
    centre: Tensor
    position: Tensor
    bin_of_row: Tensor
    fold: Tensor
    rssi: Tensor
    count: Tensor
    kernel: Kernel
    n_primitives: int
    rendered: Tensor
    prior_mean: PathLoss
    field_db: Tensor
    noise_db: Tensor
    baselines: PathLoss
    baseline_held_out: Tensor


@single_thread()
def prepare(train: Rssi, pool: Rssi, config: RssiConfig, like: RssiTraining | None = None) -> RssiTraining:
    """Average the rows by location bin, fit the path-loss models and choose the kernel.

    Args:
        train: See `RssiModel.fit`.
        pool: See `RssiModel.fit`.
        config: Options.
        like: Training data of the same pool whose kernel is taken. Defaults to a choice on held-out rows.
    """
    position, rssi, count, bin_of_row = bin_locations(train, config.max_locations)
    pool_rssi = bin_locations(pool, config.max_locations)[1]
    fold = folds(position, config.validation, config.seed, session=_most_frequent(train.session, bin_of_row))
    centre = position.mean(dim=0)
    local, receiver = position - centre, train.receiver_position.double() - centre
    distance = log_distance(local, receiver)
    pool_distance = log_distance(local, pool.receiver_position.double() - centre)

    def fit_baselines(rows: Tensor) -> PathLoss:
        """Fit the simple predictors to some of the bins."""
        detected = ~rssi[rows].isnan()
        shared = fit_shared_path_loss(
            pool_distance[rows], pool_rssi[rows], pool.receiver_located, train.receiver_located
        )
        own = fit_path_loss(distance[rows], rssi[rows]).where(detected.sum(dim=0) >= MIN_TRAINING, shared)
        mean = PathLoss(rssi[rows].nanmean(dim=0), torch.zeros_like(own.slope)).where(detected.any(dim=0), shared)
        return PathLoss(*(torch.stack(values) for values in zip(own, shared, mean, strict=True)))

    baselines = fit_baselines(torch.ones_like(fold, dtype=torch.bool))
    held_out = torch.empty(3, *distance.shape, dtype=torch.float64)
    for number in fold.unique():
        out = fold == number
        held_out[:, out] = fit_baselines(~out)(distance[out])
    own, _, mean = (PathLoss(*values) for values in zip(*baselines, strict=True))
    if config.paper_head:
        pool_residual = pool_rssi - pool_rssi.nanmean(dim=0)
        prior_mean, residual = PathLoss(torch.full_like(own.level, PAPER_LEVEL_DBM), mean.slope), rssi - mean.level
    else:
        pool_residual = pool_rssi - fit_path_loss(pool_distance, pool_rssi)(pool_distance)
        prior_mean, residual = own, rssi - own(distance)
    if like is None:
        verticals = (1.0,) if train.floors is None else VERTICALS
        kernel, helps = choose_residual_kernel(local, pool_residual, fold, verticals)
        n_primitives = config.n_primitives if helps or config.paper_head else 0
    else:
        kernel, n_primitives = like.kernel, like.n_primitives
    common = float(pool_residual.square().nanmean())  # of a receiver without measurements
    variance = residual.square().nanmean(dim=0).nan_to_num(common).clamp_min(1e-6)
    noise = kernel.noise / (1 + kernel.noise) if n_primitives else 1.0
    names = tuple(map(str, train.receiver_names))
    return RssiTraining(
        receiver_names=names,
        receiver=receiver,
        centre=centre,
        position=local,
        bin_of_row=bin_of_row,
        fold=fold,
        rssi=rssi,
        count=count,
        kernel=kernel,
        n_primitives=n_primitives,
        rendered=render([Head(name, n_primitives, config.seed).requires_grad_(False) for name in names]),
        prior_mean=prior_mean,
        field_db=((1 - noise) * variance).sqrt(),
        noise_db=(noise * variance).sqrt(),
        baselines=baselines,
        baseline_held_out=held_out,
    )


def rounding_std(rssi: Tensor) -> float:
    """Return the standard deviation of the rounding error of RSSI [dBm], the least of a prediction [dB].

    The step of the values is their least difference, at most 1 dB, which is also that of constant values.
    """
    step: float = min([MAX_STEP_DB, *rssi[~rssi.isnan()].unique().diff().tolist()])
    return step / math.sqrt(12)


def representative_receivers(pool: Rssi) -> Rssi:
    """Return the data of at most 12 receivers of the pool that detected the transmitter, evenly chosen."""
    detecting = pool.detected.any(dim=0).nonzero()[:, 0]
    return pool.columns(subsample(detecting, rows=MAX_KERNEL_RECEIVERS)[0].tolist())


def _most_frequent(session: Tensor | None, bin_of_row: Tensor) -> Tensor | None:
    """Return the session that most rows of each bin are of, int64 (n,)."""
    if session is None:
        return None
    _, own = session.unique(return_inverse=True)
    times = torch.zeros(int(bin_of_row.max()) + 1, int(own.max()) + 1)
    return times.index_put((bin_of_row, own), torch.ones(()), accumulate=True).argmax(dim=1)


def bin_locations(rows: Rssi, max_locations: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Average measurements by location bin: each row by itself, or in the cubes of a grid if there are too many rows.

    Args:
        rows: Measurements.
        max_locations: Largest number of bins.

    Returns:
        Mean position (n, 3) [m], mean RSSI (n, R) [dBm] (nan where not detected), the number of measurements in each mean
        (n, R), and the bin of each row (rows,).
    """
    position = rows.transmitter_position
    bin_of_row = torch.arange(len(position))
    if len(position) > max_locations:
        bin_of_row = cells(position, max_locations)[0]
    n = int(bin_of_row.max()) + 1

    def mean(values: Tensor) -> tuple[Tensor, Tensor]:
        total, count = (
            torch.zeros(n, values.shape[1], dtype=torch.float64).index_add(0, bin_of_row, x.double())
            for x in (values.nan_to_num(), ~values.isnan())
        )
        return total / count, count  # 0 / 0 is nan: not detected

    return mean(position)[0], *mean(rows.rssi_dbm), bin_of_row


def choose_residual_kernel(
    position: Tensor, residual: Tensor, fold: Tensor, verticals: Sequence[float] = (1.0,)
) -> tuple[Kernel, bool]:
    """Choose the kernel with the lowest mean absolute error on held-out residuals of the path-loss model.

    Args:
        position: Positions of the bins (n, 3) [m].
        residual: Residuals (n, R) [dB], nan where not detected.
        fold: Cross-validation fold of each bin, (n,).
        verticals: Factors of differences in height.

    Returns:
        The kernel, and whether its error is lower than that of no field at all.
    """
    some = (~residual.isnan()).any(dim=1)
    position, residual, fold = subsample(position[some], residual[some], fold[some], rows=MAX_KERNEL_ROWS)
    residual = residual[:, (~residual.isnan()).any(dim=0)]
    (columns,) = subsample(torch.arange(residual.shape[1]), rows=MAX_KERNEL_RECEIVERS)
    residual = residual[:, columns]
    held_out = []  # (receiver, number of values, rows)
    for r, missing in enumerate(residual.isnan().T):
        parts = [((fold == number) & ~missing).nonzero()[:, 0] for number in fold.unique()]
        # missing rows are held out with every part, so that the zeros in their place have no effect
        gaps = missing.nonzero()[:, 0]
        held_out += [(r, len(part), torch.cat([part, gaps])) for part in parts if len(part)]

    def error(kernel: Kernel) -> float:
        precision = torch.linalg.inv(kernel.covariance(position))
        dual = precision @ residual.nan_to_num()
        errors = [held_out_errors(precision, dual[:, r], out)[:n] for r, n, out in held_out]
        return float(torch.cat(errors).abs().mean())

    # rough fields only: a choice among mixtures with a smooth part follows chance, and its errors are no lower
    rough = [kernel for kernel in candidates(position, RELATIVE_NOISE_VARIANCES) if kernel.matern12_weight == 1]
    stretched = (replace(kernel, vertical=vertical) for vertical in verticals for kernel in rough)
    score, best = min(((error(kernel), kernel) for kernel in stretched), key=lambda pair: pair[0])
    return best, score < float(residual.abs().nanmean())
