"""Shared by all receivers in a fit: location bins, path-loss models, limits, the kernel, and weights of predictors.

Weights follow by stacking (L. Breiman, Machine Learning 24, 1996).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import MIN_TRAINING, each_fold, folds
from swiftwrf.errors import InputError
from swiftwrf.gp import Kernel, candidates, held_out_errors, subsample
from swiftwrf.positions import cells
from swiftwrf.rssi.base import RssiConfig, often_detected
from swiftwrf.rssi.detection import Detection, empty_given
from swiftwrf.rssi.head import Head, render
from swiftwrf.rssi.path_loss import PathLoss, PathLosses, fit_path_losses, log_distance
from swiftwrf.runtime.threads import single_thread

MAX_PAIRS = 20_000  # measurements that determine the mixing weights
# variance of a packet relative to the variance of the field: fading is as large as shadowing
RELATIVE_NOISE_VARIANCES = (0.3, 1.0, 2.0, 3.0)
MAX_KERNEL_RECEIVERS = 12  # more do not change the chosen kernel or weights
CERTAIN = 0.99  # probability that the path loss alone explains an empty cell, or a random miss does: it is left out


@dataclass(frozen=True)
class Bins:
    """Training rows averaged by location bin.

    Args:
        receiver_names: R names.
        receiver: Positions less the centre, float64 (R, 3) [m], nan where unknown.
        centre: Mean of the bins' positions, float64 (3,) [m].
        position: Mean position in each bin less the centre, float64 (n, 3) [m].
        bin_of_row: Bin of each training row, int64 (rows,).
        fold: Cross-validation fold of each bin, int64 (n,).
        rssi: Mean in each bin, float64 (n, R) [dBm], nan where not detected.
        count: Measurements in each mean, float64 (n, R).
    """

    receiver_names: tuple[str, ...]
    receiver: Tensor
    centre: Tensor
    position: Tensor
    bin_of_row: Tensor
    fold: Tensor
    rssi: Tensor
    count: Tensor


@dataclass(frozen=True)
class RssiTraining(Bins):
    """Training rows by location bin, and everything that is known before a receiver is fitted.

    Args:
        kernel: Kernel of the latent field, lengths in [m].
        rendered: Fields of each receiver's head, (R, 2, 2, directions).
        path_loss: Path loss of the receivers, the prior of the fit.
        shift: Received power less RSSI, by floors and offsets that were removed, (n, R) [dB].
        limit: Upper limit of RSSI in each empty cell that has a part in the fit, (n, R) [dBm], nan in all other cells and at
            receivers with fewer than 10 measured bins.
        field_db: Prior standard deviation of the latent field, (R,) [dB].
        noise_db: Standard deviation of one measurement about it, (R,) [dB].
        baselines: Path-loss models of the simple predictors, (3, R): that of each receiver, that of all receivers, and the
            mean of each receiver.
        baseline_held_out: Their predictions of held-out bins, (3, n, R) [dBm].
    """

    kernel: Kernel
    rendered: Tensor
    path_loss: PathLosses
    shift: Tensor
    limit: Tensor
    field_db: Tensor
    noise_db: Tensor
    baselines: PathLoss
    baseline_held_out: Tensor


@single_thread()
def prepare(pool: Rssi, own: Tensor, config: RssiConfig, shift: Tensor, curve: Detection | None) -> RssiTraining:
    """Average the rows by location bin, fit the path-loss models and choose the kernel; see `RssiPredictor._fit`.

    `own` are the columns of the receivers that are fitted.
    """
    bins = binned(pool.columns(own.tolist()), config)
    rssi, fold, every = bins.rssi, bins.fold, bin_locations(pool, config.max_locations)[1]
    receiver = pool.receiver_position.double() - bins.centre
    shift = _bin_means(shift, bins.bin_of_row, len(fold))

    def fit(rows: Tensor, detection: Detection | None) -> PathLosses:
        return fit_path_losses(bins.position[rows], receiver, every[rows], config.not_detected, shift[rows], detection)

    def simple(loss: PathLosses, rows: Tensor) -> PathLoss:
        """Return the simple predictors of the bins `rows`, from the path loss of all receivers of the pool."""
        mean, loss = rssi[rows].nanmean(dim=0), loss.columns(own)
        level = PathLoss(mean, torch.zeros_like(mean)).where(~mean.isnan(), loss.shared)
        return PathLoss(*(torch.stack(values) for values in zip(loss.own, loss.shared, level, strict=True)))

    everything = fit(torch.arange(len(fold)), curve)
    baselines = simple(everything, torch.arange(len(fold)))
    distance = log_distance(bins.position, bins.receiver)
    held_out = torch.empty(3, *distance.shape, dtype=torch.float64)
    for out, kept in each_fold(fold):
        held_out[:, out] = simple(fit(kept, everything.detection), kept)(distance[out])
    residual = (every - everything.own(log_distance(bins.position, receiver)))[:, often_detected(pool)]
    kernel, helps = choose_residual_kernel(bins.position, residual, fold, pool.floors is not None)
    n_primitives = config.n_primitives if helps else 0
    loss = everything.columns(own)
    field_db, noise_db = prior_std(loss.variance, kernel if n_primitives else None)
    head = render([Head(n_primitives, config.seed).requires_grad_(False)])
    return RssiTraining(
        **vars(bins),
        kernel=kernel,
        rendered=head.expand(len(own), *head.shape[1:]),
        path_loss=loss,
        shift=shift[:, own],
        limit=_limits(rssi, loss, distance, shift[:, own]),
        field_db=field_db,
        noise_db=noise_db,
        baselines=baselines,
        baseline_held_out=held_out,
    )


def _limits(rssi: Tensor, loss: PathLosses, distance: Tensor, shift: Tensor) -> Tensor:
    """Return the upper limit (n, R) [dBm] in each empty cell that neither path loss nor chance explains; nan elsewhere."""
    if loss.detection is None:
        return torch.full_like(rssi, torch.nan)
    limit = loss.detection.limit - shift
    std = (loss.variance + loss.detection.width**2).sqrt()
    z = (limit - loss.own(distance)) / std
    weak = empty_given(z, loss.detection.missed)[1]
    unexplained = (torch.special.ndtr(z) < CERTAIN) & (weak > 1 - CERTAIN)
    # a few rows are no evidence of weak signals elsewhere, e.g. those of a phone that passed
    enough = (~rssi.isnan()).sum(dim=0) >= MIN_TRAINING
    return limit.where(rssi.isnan() & unexplained & loss.detection.is_limit & enough, torch.nan)


def binned(train: Rssi, config: RssiConfig) -> Bins:
    """Return the training rows by location bin, with the folds that the options state."""
    position, rssi, count, bin_of_row = bin_locations(train, config.max_locations)
    session = train.session
    if session is not None:  # that most rows of each bin are of
        _, own = session.unique(return_inverse=True)
        times = torch.zeros(len(position), int(own.max()) + 1)
        session = times.index_put((bin_of_row, own), torch.ones(()), accumulate=True).argmax(dim=1)
    centre = position.mean(dim=0)
    return Bins(
        receiver_names=tuple(map(str, train.receiver_names)),
        receiver=train.receiver_position.double() - centre,
        centre=centre,
        position=position - centre,
        bin_of_row=bin_of_row,
        fold=folds(position, config.validation, config.seed, session=session),
        rssi=rssi,
        count=count,
    )


def prior_std(variance: Tensor, kernel: Kernel | None) -> tuple[Tensor, Tensor]:
    """Return prior standard deviations (R,) [dB] of latent field and noise, whose variances sum to those given, (R,) [dB^2].

    The noise of the kernel is relative to the field. Without a field the kernel is None.
    """
    noise = 1.0 if kernel is None else kernel.noise / (1 + kernel.noise)
    return ((1 - noise) * variance).sqrt(), (noise * variance).sqrt()


def bin_locations(rows: Rssi, max_locations: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Average measurements by location bin: each row by itself, or in the cubes of a grid if there are too many rows.

    Returns:
        Mean position (n, 3) [m], mean RSSI (n, R) [dBm] (nan where not detected), the number of measurements in each mean
        (n, R), and the bin of each row (rows,).
    """
    position = rows.transmitter_position
    bin_of_row = torch.arange(len(position))
    if len(position) > max_locations:
        bin_of_row = cells(position, max_locations)[0]
    n = int(bin_of_row.max()) + 1
    count = _bin_sums((~rows.rssi_dbm.isnan()).double(), bin_of_row, n)
    rssi = _bin_sums(rows.rssi_dbm.nan_to_num(), bin_of_row, n) / count  # 0 / 0 is nan: not detected
    return _bin_means(position, bin_of_row, n), rssi, count, bin_of_row


def _bin_sums(values: Tensor, bin_of_row: Tensor, n: int) -> Tensor:
    """Return the sums of values (rows, c) in n bins, float64 (n, c)."""
    return torch.zeros(n, values.shape[1], dtype=torch.float64).index_add(0, bin_of_row, values.double())


def _bin_means(values: Tensor, bin_of_row: Tensor, n: int) -> Tensor:
    return _bin_sums(values, bin_of_row, n) / bin_of_row.bincount(minlength=n)[:, None]


def choose_residual_kernel(
    position: Tensor, residual: Tensor, fold: Tensor, has_floors: bool = False
) -> tuple[Kernel, bool]:
    """Choose the kernel with the lowest mean absolute error on held-out residuals of the path-loss model.

    Residuals are (n, R) [dB], nan where not detected. With floors, differences in height may count more than others.

    Returns:
        The kernel, and whether its error is lower than that of no field at all.
    """
    some = (~residual.isnan()).any(dim=1)
    position, residual, fold = subsample(position[some], residual[some], fold[some], rows=300)
    residual = residual[:, (~residual.isnan()).any(dim=0)]
    (columns,) = subsample(torch.arange(residual.shape[1]), rows=MAX_KERNEL_RECEIVERS)
    residual = residual[:, columns]
    held_out = []  # (receiver, number of values, rows)
    for r, missing in enumerate(residual.isnan().T):
        # missing rows are held out with every part, so that the zeros in their place have no effect
        measured, gaps = (~missing).nonzero()[:, 0], missing.nonzero()[:, 0]
        held_out += [(r, len(part), torch.cat([part, gaps])) for part, _ in each_fold(fold, measured)]

    # rough fields only: a choice among mixtures with a smooth part follows chance, and its errors are no lower
    rough = [kernel for kernel in candidates(position, RELATIVE_NOISE_VARIANCES) if kernel.matern12_weight == 1]
    # floors alike, or nearly independent beyond their attenuation
    stretched = [replace(kernel, vertical=vertical) for vertical in (1.0, 5.0)[: 1 + has_floors] for kernel in rough]
    precision = torch.linalg.inv(torch.stack([kernel.covariance(position) for kernel in stretched]))
    dual = precision @ residual.nan_to_num()
    errors = [held_out_errors(precision, dual[:, :, r, None], out)[:, :n, 0] for r, n, out in held_out]
    score, best = torch.cat(errors, dim=1).abs().mean(dim=1).min(dim=0)
    return stretched[int(best)], bool(score < residual.abs().nanmean())


def comparable(held_out: Tensor, measured: Tensor) -> Tensor:
    """Return which measurements exist and are predicted by all predictors, bool (rows, R).

    Args:
        held_out: Held-out predictions (predictors, rows, R) [dBm], nan where there is none.
        measured: Measurements (rows, R) [dBm], nan where not detected.
    """
    return (~held_out.isnan()).all(dim=0) & ~measured.isnan()


def check_comparable(held_out: Tensor, measured: Tensor) -> None:
    """Raise InputError if held-out predictions (predictors, rows, R) cannot be compared with any measurement (rows, R)."""
    if not comparable(held_out, measured).any():
        raise InputError(
            "no rows can be held out to estimate the error of the model: all measurements are in one part of the "
            'region; measure elsewhere, too, give a pool of more receivers, or take validation="random"'
        )


def mixing_weights(held_out: Tensor, measured: Tensor, shrinkage: float = 0.05) -> Tensor:
    """Return the weights of the weighted mean of predictors with the lowest mean absolute error on held-out rows.

    Args:
        held_out: Held-out predictions (predictors, rows, R) [dBm], nan where there is none.
        measured: Measurements (rows, R) [dBm], nan where not detected.
        shrinkage: Ridge penalty on the distance of the weights to those of the first predictor alone, relative to the mean
            squared error of a predictor. It steadies weights that few folds determine. The default is by nested
            cross-validation.

    Returns:
        Non-negative weights of sum 1, float64 (predictors,); those of the first predictor alone without a comparable row.

    Example:
        >>> held_out = torch.tensor([[[1.0], [2.0], [3.0]], [[9.0], [9.0], [9.0]]])
        >>> mixing_weights(held_out, held_out[0]).round(decimals=2)
        tensor([1., 0.], dtype=torch.float64)
    """
    usable = comparable(held_out, measured)
    if not bool(usable.any()):
        return torch.eye(len(held_out), dtype=torch.float64)[0]
    predicted, target = subsample(held_out[:, usable].T.double(), measured[usable].double(), rows=MAX_PAIRS)
    error = (predicted - target[:, None]).numpy()  # the error of a mean with weights of sum 1 is the mean of the errors
    n = error.shape[1]
    weight, importance = np.full(n, 1 / n), np.ones(len(error))
    scale = 1e-9 * max(float((error**2).mean()), 1.0)
    away = np.eye(n)
    away[0] -= 1.0  # weights less (1, 0, ...), for weights of sum 1
    for _ in range(20):  # least absolute errors by weighted least squares
        gram = (error * importance[:, None]).T @ error / max(len(error), 1)
        gram += shrinkage * np.trace(gram) / n * away.T @ away
        # the weights of least squares are proportional to argmin of w' G w / 2 - sum w over w >= 0
        factor = np.linalg.cholesky(gram + scale * np.eye(n))
        weight = nnls(factor.T, np.linalg.solve(factor, np.ones(n)))[0]
        weight /= weight.sum()
        # absolute errors below 0.5 dB count as squares, so that the solution is unique
        importance = 1 / np.maximum(np.abs(error @ weight), 0.5)
    return torch.from_numpy(weight)


def rounding_std(rssi: Tensor) -> float:
    """Return the standard deviation of the rounding error of RSSI [dBm], the least of a prediction [dB].

    The step of the values is their least difference, at most 1 dB, which is also that of constant values.
    """
    step: float = min([1.0, *rssi[~rssi.isnan()].unique().diff().tolist()])
    return step / math.sqrt(12)
