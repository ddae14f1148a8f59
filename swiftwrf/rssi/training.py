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
from swiftwrf.data.splits import MIN_TRAINING, folds
from swiftwrf.errors import FitError, InputError
from swiftwrf.gp import GaussianProcess, Kernel, candidates, held_out_errors, subsample
from swiftwrf.positions import cells
from swiftwrf.rssi.base import RssiConfig
from swiftwrf.rssi.head import Head, HeadTable, render
from swiftwrf.rssi.path_loss import N_HARMONICS, PathLoss, fit_path_loss, fit_shared_path_loss, harmonics, log_distance
from swiftwrf.runtime.threads import single_thread

# variance of a packet relative to the variance of the field: fading is as large as shadowing
RELATIVE_NOISE_VARIANCES = (0.3, 1.0, 2.0, 3.0)
MAX_KERNEL_RECEIVERS = 12  # more do not change the chosen kernel or weights
PATH_LOSS_STD_DB = 30.0  # prior of level and slope about their least squares: as good as none
MAX_SLOPE_STD_DB = 10.0  # of a slope: path-loss exponents of 2 to 6 (Rappaport 2002, table 4.2) scatter no more
DIRECTIVITY_STD_DB = 2.0  # prior of each harmonic of a receiver's antenna and surroundings
# prior standard deviation of each coefficient that the regressors of level, slope and directivity are scaled by
FEATURE_SCALE_DB = torch.tensor([PATH_LOSS_STD_DB] * 2 + [DIRECTIVITY_STD_DB] * N_HARMONICS, dtype=torch.float64)
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
        prior_mean: Path-loss model of each receiver that its fit starts from, (R,).
        field_db: Prior standard deviation of the latent field, (R,) [dB].
        noise_db: Standard deviation of one measurement about it, (R,) [dB].
        baselines: Path-loss models of the simple predictors, (3, R): that of each receiver, that of all receivers, and the
            mean of each receiver.
        baseline_held_out: Their predictions of held-out bins, (3, n, R) [dBm].
    """

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
    bins = binned(train, config)
    rssi, fold, pool_rssi = bins.rssi, bins.fold, bin_locations(pool, config.max_locations)[1]
    distance = log_distance(bins.position, bins.receiver)
    pool_distance = log_distance(bins.position, pool.receiver_position.double() - bins.centre)

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
    own = PathLoss(*(values[0] for values in baselines))
    pool_residual = pool_rssi - fit_path_loss(pool_distance, pool_rssi)(pool_distance)
    if like is None:
        kernel, helps = choose_residual_kernel(bins.position, pool_residual, fold, train.floors is not None)
        n_primitives = config.n_primitives if helps else 0
    else:
        kernel, n_primitives = like.kernel, like.n_primitives
    field_db, noise_db = prior_std(rssi - own(distance), pool_residual, kernel if n_primitives else None)
    heads = [Head(name, n_primitives, config.seed).requires_grad_(False) for name in bins.receiver_names]
    return RssiTraining(
        **vars(bins),
        kernel=kernel,
        n_primitives=n_primitives,
        rendered=render(heads),
        prior_mean=own,
        field_db=field_db,
        noise_db=noise_db,
        baselines=baselines,
        baseline_held_out=held_out,
    )


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


def prior_std(residual: Tensor, pool_residual: Tensor, kernel: Kernel | None) -> tuple[Tensor, Tensor]:
    """Return prior standard deviations (R,) [dB] of latent field and noise, whose variances sum to that of the residuals.

    Args:
        residual: Residuals of the prior mean (n, R) [dB], nan where not detected.
        pool_residual: Those of the pool (n, P) [dB], for a receiver without measurements.
        kernel: Kernel, whose noise is relative to the field. None without a field.
    """
    common = float(pool_residual.square().nanmean())
    variance = residual.square().nanmean(dim=0).nan_to_num(common).clamp_min(1e-6)
    noise = 1.0 if kernel is None else kernel.noise / (1 + kernel.noise)
    return ((1 - noise) * variance).sqrt(), (noise * variance).sqrt()


def interval_scale(
    bins: Bins, kernel: Kernel, prior_db: tuple[Tensor, Tensor], predicted: Tensor, train: Rssi
) -> Tensor:
    """Return the factors (R,) of the standard deviations with which the 80 % intervals hold 80 % of the held-out rows.

    The interval is cross-conformal (V. Vovk, Annals of Mathematics and Artificial Intelligence 74, 2015): the error of each
    row is divided by the standard deviation that a model without the row's fold predicts.

    Args:
        bins: Training rows by location bin.
        kernel: Kernel of the latent field.
        prior_db: Standard deviations of latent field and noise, each (R,) [dB].
        predicted: Held-out predictions of the bins (n, R) [dBm], nan where there is none.
        train: Training rows.
    """
    variance = torch.empty(len(bins.position), dtype=torch.float64)
    for number in bins.fold.unique():
        out = bins.fold == number
        (known,) = subsample(bins.position[~out], rows=MAX_VARIANCE_POSITIONS)
        variance[out] = GaussianProcess(kernel, known).variance(bins.position[out])
    field_db, noise_db = prior_db
    std = (noise_db.square() + field_db.square() * variance[:, None]).sqrt()
    score = ((train.rssi_dbm - predicted[bins.bin_of_row]) / std[bins.bin_of_row]).abs()
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

    def mean(values: Tensor) -> tuple[Tensor, Tensor]:
        total, count = (
            torch.zeros(n, values.shape[1], dtype=torch.float64).index_add(0, bin_of_row, x.double())
            for x in (values.nan_to_num(), ~values.isnan())
        )
        return total / count, count  # 0 / 0 is nan: not detected

    return mean(position)[0], *mean(rows.rssi_dbm), bin_of_row


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
        - prior_level and prior_slope (R,), where the fit starts; slope 0 and no regressor of distance if RSSI rises with it.
        - slope_std (R,), the posterior standard deviation of the slope [dB a decade].
        - coefficient (R, n) of the kernel to the bins, whose sum is the latent field [dB].
        - dual, tangent and variance (R, n). See `posterior.FitState`.
        - rendered fields of the heads (R, 2, 2, directions).
        - held_out (R, n), predictions of detected bins by all other folds [dBm].

    Raises:
        FitError: A system that cannot be solved, for positions or values beyond any measurement.
    """
    rssi, receiver = data.rssi[:, some][:, 0], data.receiver[some]
    prior_mean = PathLoss(data.prior_mean.level[some], data.prior_mean.slope[some])
    distance, bearing = log_distance(data.position, receiver), harmonics(data.position, receiver)[:, 0]
    detected = (~rssi.isnan()).nonzero()[:, 0]
    feature = torch.cat([torch.ones_like(distance), distance, bearing], dim=1) * FEATURE_SCALE_DB
    error, linear, spread = torch.zeros_like(rssi), torch.zeros_like(FEATURE_SCALE_DB), distance.any().double()
    dual, tangent, noise = (torch.zeros_like(rssi) for _ in range(3))
    variance = float(data.field_db[some]) ** 2
    if len(detected):
        position = data.position[detected].to(device)
        covariance = variance * data.kernel(position, position)
        noise_db = (data.noise_db[some] / data.count[detected, some][:, 0].sqrt()).to(device)
        rest = covariance, noise_db, HeadTable(data.rendered[some].to(device)), config.huber

        def solved(prior: PathLoss) -> tuple[Tensor, Tensor, Tensor, Tensor]:
            residual = rssi - prior(distance)[:, 0]
            return solve(residual[detected].to(device), feature[detected].to(device), *rest)

        try:
            *found, factor = solved(prior_mean)
            along = feature[detected, 1].to(device)
            spread *= (1 - along @ torch.cholesky_solve(along[:, None], factor)[:, 0]).clamp(0, 1).sqrt().cpu()
            start = float(prior_mean.slope)
            if bool(along.any()) and (start == 0 or start + PATH_LOSS_STD_DB * float(found[0] @ along) > 0):
                prior_mean, feature[:, 1] = PathLoss(rssi.nanmean().reshape(1), torch.zeros(1).double()), 0.0
                *found, factor = solved(prior_mean)
            error[detected] = fold_errors(factor, found[0], data.fold[detected].to(device)).cpu()
        except torch.linalg.LinAlgError as reason:  # type: ignore[attr-defined]
            raise FitError(
                f"the RSSI fit of receiver {data.receiver_names[some][0]!r} broke ({reason}); are its values sane?"
            ) from None
        dual[detected], tangent[detected], noise[detected] = (x.cpu() for x in found)
        linear = FEATURE_SCALE_DB * (dual @ feature)
    return {
        "level": prior_mean.level + linear[0],
        "slope": prior_mean.slope + linear[1],
        "prior_level": prior_mean.level,
        "prior_slope": prior_mean.slope,
        "slope_std": (PATH_LOSS_STD_DB * spread).clamp_max(MAX_SLOPE_STD_DB)[None],
        "directivity": linear[None, 2:],
        "coefficient": variance * (tangent * dual)[None],
        "dual": dual[None],
        "tangent": tangent[None],
        "variance": noise[None],
        "rendered": data.rendered[some],
        "held_out": (rssi.nan_to_num() - error)[None],
    }


def solve(
    residual: Tensor, feature: Tensor, covariance: Tensor, noise_db: Tensor, table: HeadTable, huber: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Fit residual = feature b + head(c) + noise in n bins, with b standard normal and c of a given covariance.

    Args:
        residual: RSSI less the prior mean, (n,) [dB].
        feature: Scaled regressors, (n, k).
        covariance: Covariance of the latent field c, (n, n) [dB^2].
        noise_db: Standard deviation of the noise, (n,) [dB].
        table: Head of the receiver.
        huber: See `RssiConfig`.

    Returns:
        Dual coefficients (n,), i.e. the inverse covariance of the data times the data; the slope of the tangent (n,); the
        variance of the noise over the weights (n,) [dB^2]; the Cholesky factor of the covariance of the data (n, n).
    """
    zero = table(torch.zeros(1, 1, dtype=torch.float64, device=residual.device))[0][0, 0]
    weight, latent = torch.ones_like(residual), torch.zeros_like(residual)
    step, last = 1.0, math.inf
    for _ in range(30):
        head, slope = (x[:, 0] for x in table(latent[:, None]))
        target = residual - (head - zero) + slope * latent
        variance = noise_db.square() / weight
        whole = (slope[:, None] * covariance).mul_(slope).addmm_(feature, feature.T)
        whole.diagonal().add_(variance)
        factor = torch.linalg.cholesky(whole)
        dual = torch.cholesky_solve(target[:, None], factor)[:, 0]
        change = covariance @ (slope * dual) - latent
        mean_change = float(change.abs().mean())
        if mean_change > 0.9 * last:  # oscillates where the head bends
            step /= 2
        latent, last = latent + step * change, mean_change
        previous, error = weight, (variance * dual).abs()  # of the data about the tangent
        weight = (huber * noise_db / error.clamp_min(1e-12)).clamp_max(1)
        settled = float((weight - previous).abs().max()) < WEIGHT_TOLERANCE
        if settled and (step == 1 or mean_change < 0.1):
            break
    return dual, slope, variance, factor


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
