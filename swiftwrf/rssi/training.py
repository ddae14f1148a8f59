"""Shared by all receivers in a fit: location bins, path-loss models, limits and the kernel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import MIN_TRAINING, each_fold, folds
from swiftwrf.errors import InputError
from swiftwrf.gp import Kernel, candidates, held_out_errors, subsample
from swiftwrf.positions import cells
from swiftwrf.rssi.base import often_detected
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.detection import Detection, empty_given
from swiftwrf.rssi.head import Heads
from swiftwrf.rssi.path_loss import PathLosses, fit_path_losses, log_distance
from swiftwrf.runtime.threads import single_thread


@dataclass(frozen=True)
class Bins:
    """Training rows averaged by location bin: each row by itself, or in the cubes of a grid if there are too many rows.

    Args:
        receiver_names: R names.
        receiver: Positions less the centre, float64 (R, 3) [m], nan where unknown.
        centre: Mean of the bins' positions, float64 (3,) [m].
        position: Mean position in each bin less the centre, float64 (n, 3) [m].
        bin_of_row: Bin of each training row, int64 (rows,).
        folds: Cross-validation fold of each bin, int64 (n,): that of all choices, and that whose errors scale the standard
            deviations, if it is another.
        rssi: Mean in each bin, float64 (n, R) [dBm], nan where not detected.
        count: Measurements in each mean, float64 (n, R).
    """

    receiver_names: tuple[str, ...]
    receiver: Tensor
    centre: Tensor
    position: Tensor
    bin_of_row: Tensor
    folds: tuple[Tensor, ...]
    rssi: Tensor
    count: Tensor

    @classmethod
    def of(cls, rows: Rssi, config: RssiConfig) -> Self:
        """Average rows by location bin, with the folds that the options state."""
        at, session = rows.transmitter_position, rows.session
        bin_of_row = cells(at, config.max_locations)[0] if len(at) > config.max_locations else torch.arange(len(at))
        position = _bin_sums(at, bin_of_row) / bin_of_row.bincount()[:, None]
        count = _bin_sums(rows.detected, bin_of_row)
        rssi = _bin_sums(rows.rssi_dbm.nan_to_num(), bin_of_row) / count  # 0 / 0 is nan: not detected
        if session is not None:  # that most rows of each bin are of
            number = session.unique(return_inverse=True)[1]
            session = _bin_sums(torch.nn.functional.one_hot(number), bin_of_row).argmax(dim=1)
        centre, kinds = position.mean(dim=0), (config.validation, config.calibration or config.validation)
        return cls(
            receiver_names=tuple(map(str, rows.receiver_names)),
            receiver=rows.receiver_position.double() - centre,
            centre=centre,
            position=position - centre,
            bin_of_row=bin_of_row,
            folds=tuple(folds(position, kind, config.seed, session=session) for kind in dict.fromkeys(kinds)),
            rssi=rssi,
            count=count,
        )

    @property
    def fold(self) -> Tensor:
        """Fold of each bin that determines all choices, int64 (n,)."""
        return self.folds[0]

    @property
    def noise_scale(self) -> Tensor:
        """Variance of the noise of each bin's means relative to that of one row, float64 (n,)."""
        return 1 / self.bin_of_row.bincount().double()

    def means(self, values: Tensor) -> Tensor:
        """Return the means of values (rows, c) in each bin, float64 (n, c)."""
        return _bin_sums(values, self.bin_of_row) / self.bin_of_row.bincount()[:, None]

    def columns(self, number: Tensor) -> Self:
        """Return the bins of the receivers `number`."""
        names = tuple(self.receiver_names[n] for n in number.tolist())
        rssi, count = self.rssi[:, number], self.count[:, number]
        return replace(self, receiver_names=names, receiver=self.receiver[number], rssi=rssi, count=count)


def _bin_sums(values: Tensor, bin_of_row: Tensor) -> Tensor:
    """Return the sums of values (rows, c) in each bin, float64 (n, c)."""
    n = int(bin_of_row.max()) + 1
    return torch.zeros(n, values.shape[1], dtype=torch.float64).index_add(0, bin_of_row, values.double())


@dataclass(frozen=True)
class RssiTraining(Bins):
    """Training rows by location bin, and everything that is known before a receiver is fitted.

    Args:
        kernel: Kernel of the latent field, lengths in [m].
        heads: Head of all receivers.
        path_loss: Path loss of the receivers, the prior of the fit.
        shift: Received power less RSSI, by floors and offsets that were removed, (n, R) [dB].
        limit: Upper limit of RSSI in each empty cell that has a part in the fit, (n, R) [dBm], nan in all other cells and at
            receivers with fewer than 10 measured bins.
        field_db: Prior standard deviation of the latent field, (R,) [dB]; 0 without a field.
        noise_db: Standard deviation of one measurement about it, (R,) [dB].
    """

    kernel: Kernel
    heads: Heads
    path_loss: PathLosses
    shift: Tensor
    limit: Tensor
    field_db: Tensor
    noise_db: Tensor

    def columns(self, number: Tensor) -> Self:
        kept = {name: getattr(self, name)[..., number] for name in ("shift", "limit", "field_db", "noise_db")}
        return replace(super().columns(number), path_loss=self.path_loss.columns(number), **kept)


@single_thread()
def prepare(
    pool: Rssi, fitted: Tensor, config: RssiConfig, shift: Tensor, curve: Detection | None
) -> list[RssiTraining]:
    """Average the rows by location bin, fit the path-loss models and choose the kernel; see `RssiPredictor._fit`.

    `fitted` are the columns of the receivers that are fitted. A second result is without limits, if "auto" has some.
    """
    of_pool = Bins.of(pool, config)
    check_folds(of_pool.fold, of_pool.rssi)
    bins, position, shift = of_pool.columns(fitted), of_pool.position, of_pool.means(shift)
    rows = position, of_pool.receiver, of_pool.rssi, config.not_detected, shift
    losses, shift = [fit_path_losses(*rows, curve)], shift[:, fitted]
    distance = log_distance(position, of_pool.receiver)
    limits = [_limits(bins.rssi, losses[0].columns(fitted), distance[:, fitted], shift)]
    if config.not_detected == "auto" and curve is not None and not bool(limits[0].isnan().all()):
        losses.append(fit_path_losses(*rows, replace(curve, is_limit=torch.zeros_like(curve.is_limit))))
        limits.append(torch.full_like(limits[0], torch.nan))
    residual = torch.stack([of_pool.rssi - each.each(distance) for each in losses], dim=-1)[:, often_detected(pool)]
    # values above a limit vary less than all, so that too little noise would seem best
    with_limits = min(config.least_noise_with_limits, max(config.noises))
    least = [with_limits if bool(limit.isfinite().any()) else 0.0 for limit in limits]
    kernels = choose_residual_kernels(bins, residual, config.noises, pool.floors is not None, least)
    heads, results = Heads.alike(config.n_primitives, config.seed), []
    for each, limit, (kernel, has_field) in zip(losses, limits, kernels, strict=True):
        loss = each.columns(fitted)
        used = kernel if has_field and config.n_primitives else None
        field_db, noise_db = prior_std(loss.variance, used, bins.noise_scale)
        training = RssiTraining(
            **vars(bins),
            kernel=kernel,
            heads=heads,
            path_loss=loss,
            shift=shift,
            limit=limit,
            field_db=field_db,
            noise_db=noise_db,
        )
        results.append(training)
    return results


def _limits(rssi: Tensor, loss: PathLosses, distance: Tensor, shift: Tensor, certain: float = 0.99) -> Tensor:
    """Return the upper limit (n, R) [dBm] in each empty cell that neither path loss nor chance explains; nan elsewhere.

    A cell is explained with the probability `certain`, which saves time. Not studied.
    """
    if loss.detection is None:
        return torch.full_like(rssi, torch.nan)
    limit = loss.detection.limit - shift
    std = (loss.variance + loss.detection.width**2).sqrt()
    z = (limit - loss.each(distance)) / std
    weak = empty_given(z, loss.detection.missed)[1]
    unexplained = (torch.special.ndtr(z) < certain) & (weak > 1 - certain)
    # a few rows are no evidence of weak signals elsewhere, e.g. those of a phone that passed
    enough = (~rssi.isnan()).sum(dim=0) >= MIN_TRAINING
    return limit.where(rssi.isnan() & unexplained & loss.detection.is_limit & enough, torch.nan)


def check_folds(fold: Tensor, rssi: Tensor) -> None:
    """Raise InputError if fewer than two folds (n,) have a measurement (n, R), so that none predicts another."""
    if len(fold[(~rssi.isnan()).any(dim=1)].unique()) < 2:
        raise InputError(
            "no rows can be held out to estimate the error of the model: all measurements are in one part of the "
            'region; measure elsewhere, too, give a pool of more receivers, or take validation="random"'
        )


def prior_std(variance: Tensor, kernel: Kernel | None, noise_scale: Tensor) -> tuple[Tensor, Tensor]:
    """Return prior standard deviations (R,) [dB] of latent field and of the noise of one row.

    Args:
        variance: Variance of the means in n bins about the path loss, (R,) [dB^2].
        kernel: Kernel, whose noise is relative to the field; None without a field.
        noise_scale: Variance of the noise of a mean relative to that of one row, (n,).
    """
    of_mean = noise_scale.mean()
    if kernel is None:
        return torch.zeros_like(variance), (variance / of_mean).sqrt()
    field = variance / (1 + kernel.noise * of_mean)
    return field.sqrt(), (kernel.noise * field).sqrt()


def choose_residual_kernels(
    bins: Bins,
    residual: Tensor,
    noises: tuple[float, ...],
    has_floors: bool = False,
    least_noise: Sequence[float] = (0.0,),
) -> list[tuple[Kernel, bool]]:
    """Choose the kernel with the lowest mean absolute error on held-out residuals of each of several path-loss models.

    Args:
        bins: Location bins.
        residual: Residuals of k path-loss models, (n, P, k) [dB], nan where not detected.
        noises: Compared variances of one row, relative to that of the field.
        has_floors: Whether differences in height may count more than others.
        least_noise: Smallest variance of each path-loss model, (k,).

    Returns:
        For each path-loss model the kernel, and whether its error is lower than that of no field at all.
    """
    detected = ~residual[..., 0].isnan()
    rows = bins.position, residual[:, detected.any(dim=0)], bins.fold, bins.noise_scale
    position, residual, fold, noise_scale = subsample(*(each[detected.any(dim=1)] for each in rows), rows=300)
    (columns,) = subsample(torch.arange(residual.shape[1]), rows=12)  # more rows or receivers do not change the choice
    residual = residual[:, columns]
    # floors alike, or nearly independent beyond their attenuation
    kernels = [
        replace(kernel, vertical=vertical)
        for vertical in (1.0, 5.0)[: 1 + has_floors]
        for kernel in rough_candidates(position, noises)
    ]
    covariance = torch.stack([kernel(position, position) + (kernel.noise * noise_scale).diag() for kernel in kernels])
    of_all, errors = torch.cholesky_inverse(torch.linalg.cholesky(covariance)), []
    patterns, number = (~residual[..., 0].isnan()).T.unique(dim=0, return_inverse=True)
    for pattern, rows in enumerate(patterns):  # receivers that the same rows detect have the same covariances
        own, missing = rows.nonzero()[:, 0], (~rows).nonzero()[:, 0]
        kept, precision = slice(None), of_all
        if len(missing) > len(own) / 2:  # the inverse of fewer rows takes less time than to hold out the missing ones
            kept, own, missing = own, torch.arange(len(own)), missing[:0]
            precision = torch.cholesky_inverse(torch.linalg.cholesky(covariance[:, kept[:, None], kept]))
        values = residual[kept][:, number == pattern].nan_to_num()
        dual = precision @ values.flatten(1)
        # missing rows are held out with every fold, so that the zeros in their place have no effect
        for out, _ in each_fold(fold[kept], own):
            error = held_out_errors(precision, dual, torch.cat([out, missing]))[:, : len(out)]
            errors.append(error.unflatten(2, values.shape[1:]).flatten(1, 2))
    noise = torch.tensor([kernel.noise for kernel in kernels])[:, None]
    score = torch.cat(errors, dim=1).abs().mean(dim=1)
    score, best = score.masked_fill(noise < torch.tensor(least_noise), torch.inf).min(dim=0)
    better = (score < residual.flatten(0, 1).abs().nanmean(dim=0)).tolist()
    return [(kernels[number], has_field) for number, has_field in zip(best.tolist(), better, strict=True)]


def rough_candidates(position: Tensor, noises: tuple[float, ...]) -> list[Kernel]:
    """Return candidates (see `swiftwrf.gp.candidates`) without a smooth part, which chance would choose."""
    return [kernel for kernel in candidates(position, noises) if kernel.matern12_weight == 1]


def rounding_std(rssi: Tensor) -> float:
    """Return the standard deviation of the rounding error of RSSI [dBm], the least of a prediction [dB].

    The step of the values is their least difference, at most 1 dB, which is also that of constant values.
    """
    step: float = min([1.0, *rssi[~rssi.isnan()].unique().diff().tolist()])
    return step / math.sqrt(12)
