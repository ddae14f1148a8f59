"""The regression of one receiver, and the uncertainty that its rows leave.

A receiver is a MAP estimate by iteratively reweighted least squares. The latent field c of its head is a Gaussian process;
level, slope and directivity have Gaussian priors; the error is Gaussian in the middle and linear in the tails (P. J. Huber,
1964). With the head replaced by its tangent this is weighted least squares, solved again until weights and tangent converge
(Gauss-Newton). An empty cell is an upper limit, by expectation propagation.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from swiftwrf.errors import FitError
from swiftwrf.gp import GaussianProcess, Kernel, held_out_errors, subsample
from swiftwrf.rssi.base import RssiConfig
from swiftwrf.rssi.detection import empty_given
from swiftwrf.rssi.head import HeadTable
from swiftwrf.rssi.path_loss import N_HARMONICS, PathLoss, harmonics, log_distance
from swiftwrf.rssi.training import Bins, RssiTraining
from swiftwrf.runtime.threads import single_thread

DIRECTIVITY_STD_DB = 2.0  # prior of each harmonic of a receiver's antenna and surroundings
NO_SITE = 1e6  # variance of an empty cell without effect [dB^2]
DAMPING = 0.7  # of expectation propagation
WEIGHT_TOLERANCE = 3e-3  # each weight is in (0, 1]
MAX_VARIANCE_POSITIONS = 200  # measured positions that determine where the field is known


@single_thread()  # several threads add up sums in another order
def fit_receiver(some: slice, data: RssiTraining, config: RssiConfig, device: torch.device) -> dict[str, Tensor]:
    """Fit one receiver, which a slice of length 1 selects.

    Returns:
        Tensors by name, with R = 1.

        - dual, tangent, variance, prior_level, prior_slope and prior_std; see `posterior.RssiPosterior`. If RSSI would rise
          with the distance, slope and its standard deviation are 0.
        - covariance (R, 2, 2) of level and slope, given the rows.
        - held_out (R, n), predictions of the bins of the fit by all other folds [dBm].

    Raises:
        FitError: A system that cannot be solved, for positions or values beyond any measurement.
    """
    data = data.columns(some)
    rssi, limit, loss = data.rssi[:, 0], data.limit[:, 0], data.path_loss
    prior, std = loss.shared, loss.std[0].clone()
    distance = log_distance(data.position, data.receiver)
    used = (~rssi.isnan() | ~limit.isnan()).nonzero()[:, 0]
    error, dual, tangent, variance = (torch.zeros_like(rssi) for _ in range(4))
    covariance = std.square().diag()
    if len(used):
        at, weak = data.position[used].to(device), limit[used].isnan().logical_not()
        feature = regressors(data.position[used], data.receiver, loss.middle, std[None])[0]
        prior_covariance = float(data.field_db) ** 2 * data.kernel(at, at)
        noise_db = (data.noise_db / data.count[used, 0].clamp_min(1).sqrt()).to(device)
        detection = loss.detection
        censored = None if detection is None or not weak.any() else (detection.width, float(detection.missed))
        rest = prior_covariance, noise_db, HeadTable(data.rendered.to(device)), config.huber, censored

        def solved() -> tuple[Tensor, ...]:
            value = (rssi.where(limit.isnan(), limit) - prior(distance)[:, 0])[used].to(device)
            return solve(value, weak.to(device), feature.to(device), *rest)

        try:
            *found, factor = solved()
            trend = feature[:, :2].to(device)
            open_ = torch.eye(2).double() - (trend.T @ torch.cholesky_solve(trend, factor)).cpu()
            covariance = std[:, None] * open_ * std  # a slope that is held at 0 is as uncertain as a free one
            if float(prior.slope + std[1] * (found[0].cpu() @ feature[:, 1])) > 0:
                level = prior.level + prior.slope * loss.middle
                prior, std[1], feature[:, 1] = PathLoss(level, torch.zeros(1).double()), 0.0, 0.0
                *found, factor = solved()
            precision, fold = torch.cholesky_inverse(factor), data.fold[used]
            for number in fold.unique():
                part = (fold == number).nonzero()[:, 0]
                error[used[part]] = held_out_errors(precision, found[0][:, None], part.to(device))[:, 0].cpu()
        except torch.linalg.LinAlgError as reason:  # type: ignore[attr-defined]
            raise FitError(
                f"the RSSI fit of receiver {data.receiver_names[0]!r} broke ({reason}); are its values sane?"
            ) from None
        dual[used], tangent[used], variance[used], target = (x.cpu() for x in found)
        error[used] -= target  # prediction less prior
    return {
        "prior_level": prior.level,
        "prior_slope": prior.slope,
        "prior_std": std[None],
        "covariance": covariance[None],
        "dual": dual[None],
        "tangent": tangent[None],
        "variance": variance[None],
        "held_out": (prior(distance)[:, 0] - error).where(variance > 0, torch.nan)[None],
    }


def coefficient_scale(std: Tensor) -> Tensor:
    """Return the prior standard deviations (R, 10) of level, slope and directivity; see `PathLosses.std`."""
    return torch.cat([std, std.new_full((len(std), N_HARMONICS), DIRECTIVITY_STD_DB)], dim=1)


def regressors(position: Tensor, receiver: Tensor, middle: Tensor, std: Tensor) -> Tensor:
    """Return the regressors of level, slope and directivity, scaled by the standard deviations of their coefficients.

    They are float64 (R, n, 10), at positions (n, 3) for receivers at (R, 3), both [m]. For the rest see `PathLosses`.
    """
    apart = (log_distance(position, receiver) - middle)[..., None]
    feature = torch.cat([torch.ones_like(apart), apart, harmonics(position, receiver)], dim=-1)
    return (feature * coefficient_scale(std)).transpose(0, 1)


def covariance_of(field: Tensor, a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor]) -> Tensor:
    """Return the covariances (..., n, m) of rows a and b, given those of the latent field, without noise.

    Each row has a slope of the head (..., n) and scaled regressors (..., n, k).
    """
    return (a[0][..., None] * field).mul_(b[0][..., None, :]).add_(a[1] @ b[1].mT)


def huber_weight(error: Tensor, noise_db: Tensor, huber: float) -> Tensor:
    """Return the weights of errors [dB] in least squares whose solution minimises Huber's loss; see `RssiConfig`."""
    return (huber * noise_db / error.abs().clamp_min(1e-12)).clamp_max(1)


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
    weight, latent = torch.ones_like(value), torch.zeros_like(value)
    target, noise = value.where(~weak, 0.0), noise_db.square()
    precision, pull = torch.zeros_like(value), torch.zeros_like(value)  # of the sites of empty cells
    own, limits = torch.ones_like(value), torch.eye(len(value)).to(value)[:, weak]  # diagonal of the inverse covariance
    step, last = 1.0, math.inf
    for _ in range(30):
        head, slope = (x[:, 0] for x in table(latent[:, None]))
        tangent = slope * latent - head
        variance = (noise / weight).where(~weak, 1 / precision.clamp_min(1 / NO_SITE))
        whole = covariance_of(covariance, (slope, feature), (slope, feature))
        whole.diagonal().add_(variance)
        factor = torch.linalg.cholesky(whole)
        used, dual = target, torch.cholesky_solve((target + tangent)[:, None], factor)[:, 0]
        change = covariance @ (slope * dual) - latent
        mean_change = float(change.abs().mean())
        if mean_change > 0.9 * last:  # oscillates where the head bends
            step /= 2
        latent, last = latent + step * change, mean_change
        previous = weight  # and below the errors of the data about the tangent
        weight = huber_weight(variance * dual, noise_db, huber).where(~weak, 1.0)
        settled = float((weight - previous).abs().max()) < WEIGHT_TOLERANCE
        if censored is not None:
            own[weak] = torch.linalg.solve_triangular(factor, limits, upper=False).square().sum(dim=0)
            left_mean, left = used - dual / own, (1 / own - variance).clamp_min(1e-6)  # without the cell itself
            site = _site(left_mean, left, value, noise, censored)
            moved = DAMPING * (site - torch.stack([precision, pull])).where(weak, 0.0)
            precision, pull = precision + moved[0], pull + moved[1]
            informative = precision > 1 / NO_SITE
            previous = target
            target = (pull / precision.clamp_min(1e-9)).where(informative & weak, value.where(~weak, 0.0))
            settled &= float(((target - previous) * precision.sqrt())[weak].abs().mean()) < 0.02
        if settled and (step == 1 or mean_change < 0.1):
            break
    return dual, slope, variance, used, factor


def _site(mean: Tensor, variance: Tensor, limit: Tensor, noise: Tensor, censored: tuple[float, float]) -> Tensor:
    """Return precision and precision times value, (2, n), that match the likelihood of empty cells; 0 if not concave.

    `mean` [dB] and `variance` [dB^2] are those of each value by all others, without noise, (n,).
    """
    width, missed = censored
    std = (variance + noise + width**2).sqrt()
    z = (limit - mean) / std
    first = -empty_given(z, torch.tensor(missed, dtype=torch.float64, device=z.device))[0] / std  # derivatives of log p
    second = z * first / std - first.square()
    concave = (second < 0) & (1 + second * variance > 1e-3)
    found = torch.stack([-second, first - mean * second]) / (1 + second * variance)
    return found.where(concave, 0.0)


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

    `prior_db` are the standard deviations of latent field and noise, each (R,) [dB]; the rest is as in `Uncertainty`.
    """
    (field_db, noise_db), std = prior_db, torch.empty_like(bins.rssi)
    for number in bins.fold.unique():
        out = bins.fold == number
        variance, trend = Uncertainty(kernel, bins.position[~out], bins.receiver, middle, covariance)(
            bins.position[out]
        )
        std[out] = (noise_db.square() + field_db.square() * variance[:, None] + trend).sqrt()
    return std
