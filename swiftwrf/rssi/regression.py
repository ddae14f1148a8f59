"""MAP estimate of one receiver by iteratively reweighted least squares, with leave-group-out predictions.

The latent field c of a receiver's head is a Gaussian process; level, slope and directivity have Gaussian priors; the error
is Gaussian in the middle and linear in the tails (P. J. Huber, 1964). With the head replaced by its tangent this is weighted
least squares, solved again until weights and tangent converge (Gauss-Newton).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from swiftwrf.errors import FitError
from swiftwrf.gp import held_out_errors
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.head import HeadTable
from swiftwrf.rssi.path_loss import N_HARMONICS, PathLoss, harmonics, log_distance
from swiftwrf.rssi.training import RssiTraining
from swiftwrf.runtime.threads import single_thread

PATH_LOSS_STD_DB = 30.0  # prior of level and slope about their least squares: as good as none
MAX_SLOPE_STD_DB = 10.0  # of a slope: path-loss exponents of 2 to 6 (Rappaport 2002, table 4.2) scatter no more
DIRECTIVITY_STD_DB = 2.0  # prior of each harmonic of a receiver's antenna and surroundings
# prior standard deviation of each coefficient that the regressors of level, slope and directivity are scaled by
FEATURE_SCALE_DB = torch.tensor([PATH_LOSS_STD_DB] * 2 + [DIRECTIVITY_STD_DB] * N_HARMONICS, dtype=torch.float64)
MAX_ITERATIONS, WEIGHT_TOLERANCE = 30, 3e-3  # each weight is in (0, 1]
MIN_CONTRACTION = 0.9  # a change of the field above this share of the last one is an oscillation
FIELD_TOLERANCE_DB = 0.1  # mean change of the latent field that counts as converged


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
    for _ in range(MAX_ITERATIONS):
        head, slope = (x[:, 0] for x in table(latent[:, None]))
        target = residual - (head - zero) + slope * latent
        variance = noise_db.square() / weight
        whole = (slope[:, None] * covariance).mul_(slope).addmm_(feature, feature.T)
        whole.diagonal().add_(variance)
        factor = torch.linalg.cholesky(whole)
        dual = torch.cholesky_solve(target[:, None], factor)[:, 0]
        change = covariance @ (slope * dual) - latent
        mean_change = float(change.abs().mean())
        if mean_change > MIN_CONTRACTION * last:  # oscillates where the head bends
            step /= 2
        latent, last = latent + step * change, mean_change
        previous, error = weight, (variance * dual).abs()  # of the data about the tangent
        weight = (huber * noise_db / error.clamp_min(1e-12)).clamp_max(1)
        settled = float((weight - previous).abs().max()) < WEIGHT_TOLERANCE
        if settled and (step == 1 or mean_change < FIELD_TOLERANCE_DB):
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
