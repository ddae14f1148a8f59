"""The fit of the RSSI model: rows by location bin, priors and kernel, the receivers by regression, and mixing weights.

A receiver is a MAP estimate by iteratively reweighted least squares. The latent field c of its head is a Gaussian process;
level, slope and directivity have Gaussian priors; the error is Gaussian in the middle and linear in the tails (P. J. Huber,
1964). With the head replaced by its tangent this is weighted least squares, solved again until weights and tangent converge
(Gauss-Newton). Weights of several predictors follow from their held-out predictions (stacking: L. Breiman, Machine Learning
24, 1996).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import folds
from swiftwrf.errors import FitError, InputError
from swiftwrf.gp import GaussianProcess, Kernel, candidates, held_out_errors, subsample
from swiftwrf.positions import cells
from swiftwrf.rssi.base import RssiConfig, columns_of
from swiftwrf.rssi.detection import Detection, empty_given
from swiftwrf.rssi.head import Head, HeadTable, render
from swiftwrf.rssi.path_loss import N_HARMONICS, PathLoss, PathLosses, fit_path_losses, harmonics, log_distance
from swiftwrf.runtime.threads import single_thread

# variance of a packet relative to the variance of the field: fading is as large as shadowing
RELATIVE_NOISE_VARIANCES = (0.3, 1.0, 2.0, 3.0)
MAX_KERNEL_RECEIVERS = 12  # more do not change the chosen kernel or weights
DIRECTIVITY_STD_DB = 2.0  # prior of each harmonic of a receiver's antenna and surroundings
CERTAIN = 0.99  # probability that the path loss alone explains an empty cell, or a random miss does: it is left out
NO_SITE = 1e6  # variance of an empty cell without effect [dB^2]
DAMPING = 0.7  # of expectation propagation
WEIGHT_TOLERANCE = 3e-3  # each weight is in (0, 1]
LEVEL = 0.8  # nominal coverage of the interval that the standard deviation is calibrated for
MAX_VARIANCE_POSITIONS = 200  # measured positions that determine where the field is known
MAX_PAIRS = 20_000  # measurements that determine the mixing weights


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
        n_primitives: Number of primitives a receiver.
        rendered: Fields of each receiver's head, (R, 2, 2, directions).
        path_loss: Path loss of the receivers, the prior of the fit.
        limit: Upper limit in each empty cell that has a part in the fit, (n, R) [dBm], nan in all other cells.
        field_db: Prior standard deviation of the latent field, (R,) [dB].
        noise_db: Standard deviation of one measurement about it, (R,) [dB].
        baselines: Path-loss models of the simple predictors, (3, R): that of each receiver, that of all receivers, and the
            mean of each receiver.
        baseline_held_out: Their predictions of held-out bins, (3, n, R) [dBm].
    """

    kernel: Kernel
    n_primitives: int
    rendered: Tensor
    path_loss: PathLosses
    limit: Tensor
    field_db: Tensor
    noise_db: Tensor
    baselines: PathLoss
    baseline_held_out: Tensor


@single_thread()
def prepare(
    train: Rssi, pool: Rssi, config: RssiConfig, like: RssiTraining | None = None, shift: Tensor | None = None
) -> RssiTraining:
    """Average the rows by location bin, fit the path-loss models and choose the kernel.

    Args:
        train: See `RssiModel.fit`.
        pool: See `RssiModel.fit`.
        config: Options.
        like: Training data of the same pool whose kernel is taken. Defaults to a choice on held-out rows.
        shift: Received power less RSSI of the pool, e.g. by floors that were removed, (rows, P) [dB]. Defaults to 0.
    """
    bins = binned(train, config)
    rssi, fold, every = bins.rssi, bins.fold, bin_locations(pool, config.max_locations)[1]
    receiver, own = pool.receiver_position.double() - bins.centre, columns_of(train.receiver_names, pool)
    offset = torch.zeros_like(every) if shift is None else _bin_means(shift, bins.bin_of_row, len(fold))

    def fit_baselines(rows: Tensor, detection: Detection | None = None) -> tuple[PathLosses, PathLoss]:
        """Fit the simple predictors to some of the bins, the path loss of all receivers of the pool together."""
        loss = fit_path_losses(bins.position[rows], receiver, every[rows], config.not_detected, offset[rows], detection)
        mean = rssi[rows].nanmean(dim=0)
        simple = loss.columns(own)
        level = PathLoss(mean, torch.zeros_like(mean)).where(~mean.isnan(), simple.shared)
        return loss, PathLoss(*(torch.stack(values) for values in zip(simple.own, simple.shared, level, strict=True)))

    everything, baselines = fit_baselines(torch.ones_like(fold, dtype=torch.bool))
    distance = log_distance(bins.position, bins.receiver)
    held_out = torch.empty(3, *distance.shape, dtype=torch.float64)
    for number in fold.unique():
        out = fold == number
        held_out[:, out] = fit_baselines(~out, everything.detection)[1](distance[out])
    pool_residual = every - everything.own(log_distance(bins.position, receiver))
    if like is None:
        kernel, helps = choose_residual_kernel(bins.position, pool_residual, fold, train.floors is not None)
        n_primitives = config.n_primitives if helps else 0
    else:
        kernel, n_primitives = like.kernel, like.n_primitives
    loss = everything.columns(own)
    field_db, noise_db = prior_std(loss.variance, kernel if n_primitives else None)
    heads = [Head(name, n_primitives, config.seed).requires_grad_(False) for name in bins.receiver_names]
    return RssiTraining(
        **vars(bins),
        kernel=kernel,
        n_primitives=n_primitives,
        rendered=render(heads),
        path_loss=loss,
        limit=_limits(rssi, loss, distance, offset[:, own]),
        field_db=field_db,
        noise_db=noise_db,
        baselines=baselines,
        baseline_held_out=held_out,
    )


def _limits(rssi: Tensor, loss: PathLosses, distance: Tensor, offset: Tensor) -> Tensor:
    """Return the upper limit (n, R) [dBm] in each empty cell that neither path loss nor chance explains; nan elsewhere."""
    if loss.detection is None:
        return torch.full_like(rssi, torch.nan)
    limit = loss.detection.limit - offset
    std = (loss.variance + loss.detection.width**2).sqrt()
    z = (limit - loss.own(distance)) / std
    weak = empty_given(z, loss.detection.missed)[1]
    unexplained = (torch.special.ndtr(z) < CERTAIN) & (weak > 1 - CERTAIN)
    received = (~rssi.isnan()).any(dim=0)
    return limit.where(rssi.isnan() & unexplained & loss.detection.is_limit & received, torch.nan)


def binned(train: Rssi, config: RssiConfig) -> Bins:
    """Return the training rows by location bin, with the folds that the options state."""
    position, rssi, count, bin_of_row = bin_locations(train, config.max_locations)
    session = _most_frequent(train.session, bin_of_row)
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


class Uncertainty:
    """Variance of what n measured positions leave open: of the latent field, and of the path loss as a trend beside it.

    The trend is that of universal kriging (N. Cressie, "Statistics for Spatial Data", revised ed., 1993, section 3.4): a
    level or slope that the rows determine badly counts where the field does not follow from rows nearby.

    Args:
        kernel: Kernel of the latent field.
        known: Measured positions less the centre, (n, 3) [m]; 200 of them count.
        receiver: Positions of the receivers less the centre, (R, 3) [m].
        middle: log10 of the distance at which levels are compared, (R,).
        covariance: Covariance of level and slope of each receiver, (R, 2, 2).
    """

    def __init__(self, kernel: Kernel, known: Tensor, receiver: Tensor, middle: Tensor, covariance: Tensor) -> None:
        (known,) = subsample(known, rows=MAX_VARIANCE_POSITIONS)
        self._receiver, self._middle, self._covariance = receiver, middle, covariance
        self._process = GaussianProcess.regress(kernel, known, self._trend(known))

    def _trend(self, position: Tensor) -> Tensor:
        """Return the regressors of level, and of the slope of each receiver, (n, 1 + R)."""
        apart = log_distance(position, self._receiver) - self._middle
        return torch.cat([torch.ones_like(apart[:, :1]), apart], dim=1)

    def __call__(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """Return the variance of the field (m,), relative to that far from all rows, and of the trend, (m, R) [dB^2]."""
        level, slope = (self._trend(position) - self._process.mean(position)).split([1, len(self._middle)], dim=1)
        of_level, both, of_slope = self._covariance[:, 0, 0], self._covariance[:, 0, 1], self._covariance[:, 1, 1]
        trend = of_level * level.square() + 2 * both * level * slope + of_slope * slope.square()
        return self._process.variance(position), trend.clamp_min(0)


def held_out_std(
    bins: Bins, kernel: Kernel, prior_db: tuple[Tensor, Tensor], middle: Tensor, covariance: Tensor
) -> Tensor:
    """Return the standard deviations (n, R) [dB] that models without a bin's fold predict, before they are calibrated.

    Args:
        bins: Training rows by location bin.
        kernel: Kernel of the latent field.
        prior_db: Standard deviations of latent field and noise, each (R,) [dB].
        middle: See `Uncertainty`.
        covariance: See `Uncertainty`.
    """
    (field_db, noise_db), std = prior_db, torch.empty_like(bins.rssi)
    for number in bins.fold.unique():
        out = bins.fold == number
        variance, trend = Uncertainty(kernel, bins.position[~out], bins.receiver, middle, covariance)(
            bins.position[out]
        )
        std[out] = (noise_db.square() + field_db.square() * variance[:, None] + trend).sqrt()
    return std


def interval_scale(predicted: Tensor, std: Tensor, measured: Tensor) -> Tensor:
    """Return the factors (R,) of the standard deviations with which the 80 % intervals hold 80 % of the held-out rows.

    The interval is cross-conformal (V. Vovk, Annals of Mathematics and Artificial Intelligence 74, 2015): the error of each
    row is divided by the standard deviation that a model without the row's fold predicts.

    Args:
        predicted: Held-out predictions of the rows (n, R) [dBm], nan where there is none.
        std: Their standard deviations (n, R) [dB].
        measured: Measurements of the rows, (n, R) [dBm].
    """
    score = ((measured - predicted) / std).abs()
    finite = score.where(score.isfinite(), torch.nan)
    quantile = finite.nanquantile(LEVEL, dim=0)
    few = (~finite.isnan()).sum(dim=0) < 30  # scores of all receivers count
    if few.any():
        quantile = quantile.where(~few, score[score.isfinite()].quantile(LEVEL))
    return quantile / NormalDist().inv_cdf((1 + LEVEL) / 2)


def check_comparable(held_out: Tensor, measured: Tensor) -> None:
    """Refuse held-out predictions (predictors, rows, R) that cannot be compared with any measurement (rows, R).

    Raises:
        InputError: As described.
    """
    if not comparable(held_out, measured).any():
        raise InputError(
            "no rows can be held out to estimate the error of the model: all measurements are in one part of the "
            'region; measure elsewhere, too, give a pool of more receivers, or take validation="random"'
        )


def rounding_std(rssi: Tensor) -> float:
    """Return the standard deviation of the rounding error of RSSI [dBm], the least of a prediction [dB].

    The step of the values is their least difference, at most 1 dB, which is also that of constant values.
    """
    step: float = min([1.0, *rssi[~rssi.isnan()].unique().diff().tolist()])
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

    Args:
        position: Positions of the bins (n, 3) [m].
        residual: Residuals (n, R) [dB], nan where not detected.
        fold: Cross-validation fold of each bin, (n,).
        has_floors: Whether differences in height may count more than horizontal ones.

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
    # floors alike, or nearly independent beyond their attenuation
    stretched = (replace(kernel, vertical=vertical) for vertical in (1.0, 5.0)[: 1 + has_floors] for kernel in rough)
    score, best = min(((error(kernel), kernel) for kernel in stretched), key=lambda pair: pair[0])
    return best, score < float(residual.abs().nanmean())


@single_thread()  # several threads add up sums in another order
def fit_receiver(some: slice, data: RssiTraining, config: RssiConfig, device: torch.device) -> dict[str, Tensor]:
    """Fit one receiver.

    Args:
        some: The receiver, as a slice of length 1.
        data: Training data.
        config: Options.
        device: Device to compute on.

    Returns:
        Tensors by name, with R = 1.

        - level (R,) [dBm], slope (R,) [dB a decade] and directivity (R, 8) [dB].
        - covariance (R, 2, 2) of level and slope, given the rows.
        - prior_level, prior_slope and prior_std (R,), (R,), (R, 2): the prior path loss. If RSSI would rise with the
          distance, slope and its standard deviation are 0.
        - coefficient (R, n) of the kernel to the bins, whose sum is the latent field [dB].
        - dual, tangent and variance (R, n). See `posterior.FitState`.
        - rendered fields of the heads (R, 2, 2, directions).
        - held_out (R, n), predictions of the bins of the fit by all other folds [dBm].

    Raises:
        FitError: A system that cannot be solved, for positions or values beyond any measurement.
    """
    rssi, receiver, limit = data.rssi[:, some][:, 0], data.receiver[some], data.limit[:, some][:, 0]
    loss = data.path_loss.columns(torch.arange(len(data.receiver_names))[some])
    prior, std = loss.shared, loss.std[0].clone()
    distance = log_distance(data.position, receiver)
    used = (~rssi.isnan() | ~limit.isnan()).nonzero()[:, 0]
    error, dual, tangent, variance = (torch.zeros_like(rssi) for _ in range(4))
    feature = regressors(distance, harmonics(data.position, receiver), loss.centre, std[None])[0]
    linear, covariance = torch.zeros(feature.shape[1]).double(), std.square().diag()
    if len(used):
        at, weak = data.position[used].to(device), limit[used].isnan().logical_not()
        prior_covariance = float(data.field_db[some]) ** 2 * data.kernel(at, at)
        noise_db = (data.noise_db[some] / data.count[used, some][:, 0].clamp_min(1).sqrt()).to(device)
        detection = loss.detection
        censored = None if detection is None or not weak.any() else (detection.width, float(detection.missed))
        rest = prior_covariance, noise_db, HeadTable(data.rendered[some].to(device)), config.huber, censored

        def solved() -> tuple[Tensor, ...]:
            value = (rssi.where(limit.isnan(), limit) - prior(distance)[:, 0])[used].to(device)
            return solve(value, weak.to(device), feature[used].to(device), *rest)

        try:
            *found, factor = solved()
            trend = feature[used, :2].to(device)
            open_ = torch.eye(2).double() - (trend.T @ torch.cholesky_solve(trend, factor)).cpu()
            covariance = std[:, None] * open_ * std  # a slope that is held at 0 is as uncertain as a free one
            slope = float(prior.slope + std[1] * (found[0].cpu() @ feature[used, 1]))
            if slope > 0:
                middle = prior.level + prior.slope * loss.centre
                prior, std[1], feature[:, 1] = PathLoss(middle, torch.zeros(1).double()), 0.0, 0.0
                *found, factor = solved()
            error[used] = fold_errors(factor, found[0], data.fold[used].to(device)).cpu()
        except torch.linalg.LinAlgError as reason:  # type: ignore[attr-defined]
            raise FitError(
                f"the RSSI fit of receiver {data.receiver_names[some][0]!r} broke ({reason}); are its values sane?"
            ) from None
        dual[used], tangent[used], variance[used], target = (x.cpu() for x in found)
        linear = dual @ feature * coefficient_scale(std[None])[0]
        error[used] -= target  # prediction less prior
    return {
        "level": prior.level + linear[0] - linear[1] * loss.centre,
        "slope": prior.slope + linear[1],
        "covariance": covariance[None],
        "prior_level": prior.level,
        "prior_slope": prior.slope,
        "prior_std": std[None],
        "directivity": linear[None, 2:],
        "coefficient": float(data.field_db[some]) ** 2 * (tangent * dual)[None],
        "dual": dual[None],
        "tangent": tangent[None],
        "variance": variance[None],
        "rendered": data.rendered[some],
        "held_out": (prior(distance)[:, 0] - error).where(variance > 0, torch.nan)[None],
    }


def coefficient_scale(std: Tensor) -> Tensor:
    """Return the prior standard deviations (R, 10) of level, slope and directivity; see `PathLosses.std`."""
    return torch.cat([std, std.new_full((len(std), N_HARMONICS), DIRECTIVITY_STD_DB)], dim=1)


def regressors(distance: Tensor, bearing: Tensor, middle: Tensor, std: Tensor) -> Tensor:
    """Return the regressors of level, slope and directivity, scaled by the standard deviations of their coefficients.

    Args:
        distance: log10 of the distances [m], (n, R).
        bearing: Harmonics of the directions, (n, R, 8).
        middle: log10 of the distance at which levels are compared, (R,).
        std: Prior standard deviation of level and slope, (R, 2).

    Returns:
        float64 (R, n, 10).
    """
    apart = (distance - middle)[..., None]
    feature = torch.cat([torch.ones_like(apart), apart, bearing], dim=-1) * coefficient_scale(std)
    return feature.transpose(0, 1)


def solve(
    value: Tensor,
    weak: Tensor,
    feature: Tensor,
    covariance: Tensor,
    noise_db: Tensor,
    table: HeadTable,
    huber: float,
    censored: tuple[float, float] | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Fit value = feature b + head(c) + noise in n bins, with b standard normal and c of a given covariance.

    An upper limit enters as a value and a variance that match the moments of its likelihood (expectation propagation: C. E.
    Rasmussen and C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, section 3.6).

    Args:
        value: RSSI, or its upper limit, less the prior mean, (n,) [dB].
        weak: Whether a value is an upper limit, bool (n,).
        feature: Scaled regressors, (n, k).
        covariance: Covariance of the latent field c, (n, n) [dB^2].
        noise_db: Standard deviation of the noise, (n,) [dB].
        table: Head of the receiver.
        huber: See `RssiConfig`.
        censored: Width of the limits [dB] and share of random misses. None without limits.

    Returns:
        Dual coefficients (n,), i.e. the inverse covariance of the data times the data; the slope of the tangent (n,); the
        variance of the noise over the weights (n,) [dB^2]; the values, with those in place of limits, (n,) [dB]; the
        Cholesky factor of the covariance of the data (n, n).
    """
    zero = table(torch.zeros(1, 1, dtype=torch.float64, device=value.device))[0][0, 0]
    weight, latent = torch.ones_like(value), torch.zeros_like(value)
    target, noise = value.where(~weak, 0.0), noise_db.square()
    precision, pull = torch.zeros_like(value), torch.zeros_like(value)  # of the sites of empty cells
    step, last = 1.0, math.inf
    for _ in range(30):
        head, slope = (x[:, 0] for x in table(latent[:, None]))
        tangent = slope * latent - (head - zero)
        variance = (noise / weight).where(~weak, 1 / precision.clamp_min(1 / NO_SITE))
        whole = (slope[:, None] * covariance).mul_(slope).addmm_(feature, feature.T)
        whole.diagonal().add_(variance)
        factor = torch.linalg.cholesky(whole)
        used, dual = target, torch.cholesky_solve((target + tangent)[:, None], factor)[:, 0]
        change = covariance @ (slope * dual) - latent
        mean_change = float(change.abs().mean())
        if mean_change > 0.9 * last:  # oscillates where the head bends
            step /= 2
        latent, last = latent + step * change, mean_change
        previous, error = weight, (variance * dual).abs()  # of the data about the tangent
        weight = (huber * noise_db / error.clamp_min(1e-12)).clamp_max(1).where(~weak, 1.0)
        settled = float((weight - previous).abs().max()) < WEIGHT_TOLERANCE
        if censored is not None:
            own = torch.cholesky_inverse(factor).diagonal()
            left_mean, left = used - dual / own, (1 / own - variance).clamp_min(1e-6)  # without the cell itself
            site = _site(left_mean, left, value, noise, censored)
            moved = DAMPING * (site - torch.stack([precision, pull])).where(weak, 0.0)
            precision, pull = precision + moved[0], pull + moved[1]
            informative = precision > 1 / NO_SITE
            previous, target = (
                target,
                (pull / precision.clamp_min(1e-9)).where(informative & weak, value.where(~weak, 0.0)),
            )
            settled &= float(((target - previous) * precision.sqrt())[weak].abs().mean()) < 0.02
        if settled and (step == 1 or mean_change < 0.1):
            break
    return dual, slope, variance, used, factor


def _site(mean: Tensor, variance: Tensor, limit: Tensor, noise: Tensor, censored: tuple[float, float]) -> Tensor:
    """Return precision and precision times value, (2, n), that match the likelihood of empty cells; 0 if not concave.

    Args:
        mean: Mean of each value by all others, (n,) [dB].
        variance: Its variance without noise [dB^2].
        limit: Upper limits [dB].
        noise: Variance of the noise [dB^2].
        censored: See `solve`.
    """
    width, missed = censored
    std = (variance + noise + width**2).sqrt()
    z = (limit - mean) / std
    first = -empty_given(z, torch.tensor(missed, dtype=torch.float64, device=z.device))[0] / std  # derivatives of log p
    second = z * first / std - first.square()
    concave = (second < 0) & (1 + second * variance > 1e-3)
    found = torch.stack([-second, first - mean * second]) / (1 + second * variance)
    return found.where(concave, 0.0)


def fold_errors(factor: Tensor, dual: Tensor, fold: Tensor) -> Tensor:
    """Return the errors (n,) [dB] of the predictions of each bin by all other folds (n,)."""
    precision = torch.cholesky_inverse(factor)
    error = torch.empty_like(dual)
    for number in fold.unique():
        part = (fold == number).nonzero()[:, 0]
        error[part] = held_out_errors(precision, dual, part)
    return error


def comparable(held_out: Tensor, measured: Tensor) -> Tensor:
    """Return which measurements exist and are predicted by all predictors, bool (rows, R).

    Args:
        held_out: Held-out predictions (predictors, rows, R) [dBm], nan where there is none.
        measured: Measurements (rows, R) [dBm], nan where not detected.
    """
    return (~held_out.isnan()).all(dim=0) & ~measured.isnan()


def mixing_weights(held_out: Tensor, measured: Tensor, shrinkage: float = 0.0) -> Tensor:
    """Return the weights of the weighted mean of predictors with the lowest mean absolute error on held-out rows.

    Args:
        held_out: Held-out predictions (predictors, rows, R) [dBm], nan where there is none.
        measured: Measurements (rows, R) [dBm], nan where not detected.
        shrinkage: Ridge penalty on the distance of the weights to those of the first predictor alone, relative to the mean
            squared error of a predictor. It steadies weights that few folds determine.

    Returns:
        Non-negative weights of sum 1, float64 (predictors,).

    Example:
        >>> held_out = torch.tensor([[[1.0], [2.0], [3.0]], [[9.0], [9.0], [9.0]]])
        >>> mixing_weights(held_out, held_out[0]).round(decimals=2)
        tensor([1., 0.], dtype=torch.float64)
    """
    usable = comparable(held_out, measured)
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
