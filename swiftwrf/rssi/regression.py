"""The regression of one receiver, its posterior, which more rows update, and the uncertainty that the rows leave.

A receiver is a MAP estimate by iteratively reweighted least squares. The latent field c of its head is a Gaussian process;
level, slope and directivity have Gaussian priors; the error is Gaussian in the middle and linear in the tails (P. J. Huber,
1964). With the head replaced by its tangent this is weighted least squares, solved again until weights and tangent converge
(Gauss-Newton). An empty cell is an upper limit, by expectation propagation.

At its end the rows of a receiver are a Gaussian process with the kernel and the noise

    tangent_i field(x_i, x_j) tangent_j + f_i . f_j,        noise / weight_i

for the latent field and the regressors f of the path loss. Given the rows of the fit, more rows have a Gaussian
prior, which costs one product with the inverse covariance, computed once. Their robust weights are found with all of them
together, so their order has no effect. Tangents and weights of the rows of the fit stay.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Annotated, Any

import numpy as np
import torch
from scipy.linalg.blas import ssymv
from torch import Tensor
from torch.nn import functional

from swiftwrf.data.splits import each_fold
from swiftwrf.errors import FitError
from swiftwrf.gp import GaussianProcess, Kernel, held_out_errors, subsample
from swiftwrf.rssi.base import RssiConfig
from swiftwrf.rssi.detection import empty_given
from swiftwrf.rssi.head import HeadTable
from swiftwrf.rssi.path_loss import PathLoss, harmonics, log_distance
from swiftwrf.rssi.training import Bins, RssiTraining
from swiftwrf.runtime.threads import single_thread

DIRECTIVITY_STD_DB = 2.0  # prior of each harmonic of a receiver's antenna and surroundings
NO_SITE = 1e6  # variance of an empty cell without effect [dB^2]
DAMPING = 0.7  # of expectation propagation
WEIGHT_TOLERANCE = 3e-3  # each weight is in (0, 1]
NEW_WEIGHT_TOLERANCE = WEIGHT_TOLERANCE / 100  # of rows after the fit, so that their order does not matter
MAX_NEW_ROWS = 256  # beyond, the weights of new rows are fixed and the inverses are computed again
MAX_VARIANCE_POSITIONS = 200  # measured positions that determine where the field is known


@single_thread()  # several threads add up sums in another order
def fit_receiver(number: int, data: RssiTraining, config: RssiConfig, device: torch.device) -> dict[str, Tensor]:
    """Fit one receiver by its number.

    Returns:
        Tensors by name.

        - dual (n,), tangent (n,), variance (n,), prior (2,) and root (2, 2); see `RssiPosterior`. If RSSI would rise with
          the distance, slope and its standard deviation are 0.
        - covariance (2, 2) of level and slope, given the rows.
        - held_out (n,), predictions of the bins of the fit by all other folds [dBm].

    Raises:
        FitError: A system that cannot be solved, for positions or values beyond any measurement.
    """
    rssi, limit, loss, one = data.rssi[:, number], data.limit[:, number], data.path_loss, slice(number, number + 1)
    prior, root = torch.stack([loss.shared.level[number], loss.shared.slope[number]]), loss.root[number].clone()
    distance, field_db = log_distance(data.position, data.receiver[one])[:, 0], float(data.field_db[number])
    used = (~rssi.isnan() | ~limit.isnan()).nonzero()[:, 0]
    error, dual, tangent, variance = (torch.zeros_like(rssi) for _ in range(4))
    covariance = root @ root.T
    if len(used):
        at, weak = data.position[used].to(device), limit[used].isnan().logical_not()
        feature = regressors(data.position[used], data.receiver[one], root[None])[0]
        noise_db = (data.noise_db[number] / data.count[used, number].clamp_min(1).sqrt()).to(device)
        detection = loss.detection
        censored = None if detection is None or not weak.any() else (detection.width, float(detection.missed[number]))
        field, table = field_db**2 * data.kernel(at, at), HeadTable(data.rendered[one].to(device))

        def solved() -> tuple[Tensor, ...]:
            value = (rssi.where(limit.isnan(), limit) - prior[0] - prior[1] * distance)[used].to(device)
            return solve(value, weak.to(device), feature.to(device), field, noise_db, table, config.huber, censored)

        try:
            *found, factor = solved()
            trend = feature[:, :2].to(device)
            open_ = torch.eye(2).double() - (trend.T @ torch.cholesky_solve(trend, factor)).cpu()
            covariance = root @ open_ @ root.T  # a slope that is held at 0 is as uncertain as a free one
            if float(prior[1] + root[1, 1] * (found[0].cpu() @ feature[:, 1])) > 0:
                # at the distance where level and slope are independent
                prior = torch.stack([prior[0] - prior[1] * root[0, 1] / root[1, 1], torch.zeros(()).double()])
                root[:, 1], feature[:, 1] = 0.0, 0.0
                *found, factor = solved()
            precision, fold = torch.cholesky_inverse(factor), data.fold[used]
            for part, _ in each_fold(fold):
                error[used[part]] = held_out_errors(precision, found[0][:, None], part.to(device))[:, 0].cpu()
        except torch.linalg.LinAlgError as reason:  # type: ignore[attr-defined]
            raise FitError(
                f"the RSSI fit of receiver {data.receiver_names[number]!r} broke ({reason}); are its values sane?"
            ) from None
        dual[used], tangent[used], variance[used], target = (x.cpu() for x in found)
        error[used] -= target  # prediction less prior
    held_out = (prior[0] + prior[1] * distance - error).where(variance > 0, torch.nan)
    rows = {"dual": dual, "tangent": field_db * tangent, "variance": variance, "held_out": held_out}
    return rows | {"prior": prior, "root": root, "covariance": covariance}


def regressors(position: Tensor, receiver: Tensor, root: Tensor) -> Tensor:
    """Return the regressors of level, slope and directivity with standard normal coefficients, float64 (R, n, 10).

    Args:
        position: Positions (n, 3) [m].
        receiver: Positions of the receivers (R, 3) [m].
        root: See `RssiPosterior`.
    """
    apart = log_distance(position, receiver).T
    trend = torch.stack([torch.ones_like(apart), apart], dim=-1) @ root
    return torch.cat([trend, DIRECTIVITY_STD_DB * harmonics(position, receiver).transpose(0, 1)], dim=-1)


def covariance_of(field: Tensor, a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor]) -> Tensor:
    """Return the covariances (..., n, m) of rows a and b, given those of the latent field, without noise.

    Each row has a slope of the head (..., n) and regressors (..., n, k).
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
        feature: Regressors (n, k).
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


@dataclass(frozen=True, eq=False)
class FittedRows:
    """Regressions of R receivers on n rows, which a file contains.

    Args:
        anchor: Positions of the rows less the centre, (n, 3) [m].
        dual: Dual coefficients (R, n); 0 in rows that have no part in the fit.
        tangent: Slope of each head at the latent field, times the prior standard deviation of the field, (R, n) [dB].
        variance: Variance of the noise over the weight, (R, n) [dB^2]; 0 in rows that have no part in the fit.
        measured: 1 where RSSI was measured and not only limited, (R, n).
        prior: Prior path-loss model, RSSI at 1 m [dBm] and slope [dB a decade], (R, 2).
        root: A factor of their prior covariance, root @ root^T, (R, 2, 2).
        field_db: Prior standard deviation of the latent field, (R,) [dB].
        noise_db: Standard deviation of one measurement, (R,) [dB].
    """

    anchor: Annotated[Tensor, "float64 n 3"]
    dual: Annotated[Tensor, "float64 r n"]
    tangent: Annotated[Tensor, "float64 r n"]
    variance: Annotated[Tensor, "float64 r n"]
    measured: Annotated[Tensor, "float64 r n"]
    prior: Annotated[Tensor, "float64 r 2"]
    root: Annotated[Tensor, "float64 r 2 2"]
    field_db: Annotated[Tensor, "float64 r"]
    noise_db: Annotated[Tensor, "float64 r"]


@dataclass(frozen=True, eq=False, kw_only=True)
class RssiPosterior(FittedRows):
    """Gaussian processes of R receivers, given n rows.

    Args:
        receiver: Positions of the receivers less the centre, (R, 3) [m], nan where unknown.
        kernel: Kernel of the latent field.
        table: Heads of the receivers.
        huber: See `RssiConfig`.
        fit: Posterior of the first n - m rows, whose weights are fixed. Defaults to all rows.
        later: Of the m rows after those: the effect of their dual coefficients on those of the fit, float32 (R, m, n - m),
            the errors of the fit, (R, m) [dB], and the covariance of these errors without noise, (R, m, m).
    """

    receiver: Tensor
    kernel: Kernel
    table: HeadTable
    huber: float
    fit: RssiPosterior | None = None
    later: tuple[Tensor, Tensor, Tensor] | None = None

    @cached_property
    def feature(self) -> Tensor:
        """Regressors (R, n, 10); 0 in rows that have no part in the fit."""
        return regressors(self.anchor, self.receiver, self.root) * (self.variance > 0)[..., None]

    @cached_property
    def _inverses(self) -> list[Any]:
        """Inverse covariance of the rows of each receiver, float32 (n, n)."""
        field, found = self.kernel(self.anchor, self.anchor), []
        for r, feature in enumerate(self.feature):
            rows = self.tangent[r], feature
            whole = covariance_of(field, rows, rows)
            whole.diagonal().add_(self.variance[r].where(self.variance[r] > 0, 1.0))
            inverse = torch.cholesky_inverse(torch.linalg.cholesky(whole)).float()
            found.append(np.asfortranarray(inverse.numpy()))  # as BLAS reads it
        return found

    @cached_property
    def _linear(self) -> Tensor:
        """Coefficients of the regressors, (R, 10, 1)."""
        return self.feature.mT @ self.dual[..., None]

    @property
    def path_loss(self) -> Tensor:
        """RSSI at 1 m [dBm] and slope [dB a decade], float64 (R, 2)."""
        return self.prior + (self.root @ self._linear[:, :2])[..., 0]

    @property
    def directivity(self) -> Tensor:
        """Coefficients of the harmonics, float64 (R, 8) [dB]."""
        return DIRECTIVITY_STD_DB * self._linear[:, 2:, 0]

    @property
    def coefficient(self) -> Tensor:
        """Coefficients of the kernel to the rows whose sum is the latent field, float64 (n, R) [dB]."""
        return (self.field_db[:, None] * self.tangent * self.dual).T

    @property
    def rssi(self) -> Tensor:
        """RSSI of the rows, from fitted values and residuals, float64 (n, R) [dBm]; nan where not detected."""
        fitted = self._at(self.anchor, self.kernel(self.anchor, self.anchor))[0]
        return (fitted + self.variance * self.dual).where(self.measured > 0, torch.nan).T

    def _at(self, position: Tensor, cross: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return RSSI (R, m) [dBm], tangent (R, m) [dB] and regressors (R, m, 10) at positions (m, 3) [m].

        `cross` are the values of the kernel between them and the rows, (m, n).
        """
        head, tangent = self.table(cross @ self.coefficient)
        feature = regressors(position, self.receiver, self.root)
        mean = PathLoss(*self.prior.T)(log_distance(position, self.receiver)) + head
        return mean.T + (feature @ self._linear)[..., 0], self.field_db[:, None] * tangent.T, feature

    def updated(self, position: Tensor, rssi: Tensor) -> RssiPosterior:
        """Return the posterior with more rows, RSSI (m, R) [dBm], nan where not detected, at positions (m, 3) [m]."""
        n_receivers, n_new = len(self.receiver), len(position)
        fit, later = self.fit, self.later
        if fit is None or later is None or later[1].shape[1] + n_new > MAX_NEW_ROWS:
            fit = self if fit is None else replace(self, fit=None, later=None)
            none = self.dual.new_zeros(n_receivers, 0)
            later = torch.zeros(n_receivers, 0, len(fit.anchor)), none, none[..., None].expand(-1, 0, 0)
        detected, cross = ~rssi.isnan().T, self.kernel(position, fit.anchor)
        mean, tangent, feature = fit._at(position, cross)
        new = tangent * detected, feature * detected[..., None]
        # condition on the rows of the fit
        own = covariance_of(cross, new, (fit.tangent, fit.feature))
        # half of each inverse is read, because its time in memory is most of the time of a row
        pairs = zip(fit._inverses, own.float().numpy(), strict=True)
        influence = torch.from_numpy(np.stack([np.stack([ssymv(1.0, p, x, lower=1) for x in c]) for p, c in pairs]))
        influence = torch.cat([later[0], influence], dim=1)
        error = torch.cat([later[1], (rssi.T - mean).where(detected, 0.0)], dim=1)
        noise = fit.noise_db.square()[:, None] * detected
        n, anchor = len(fit.anchor), torch.cat([self.anchor, position])
        slopes, features = torch.cat([self.tangent, new[0]], dim=1), torch.cat([self.feature, new[1]], dim=1)
        border = covariance_of(self.kernel(position, anchor[n:]), new, (slopes[:, n:], features[:, n:]))
        border = border - (own.float() @ influence.mT).double()
        covariance = functional.pad(later[2], (0, n_new, 0, n_new))
        covariance[:, -n_new:], covariance[..., -n_new:] = border, border.mT
        dual, variance = self._robust(covariance, error, torch.cat([self.variance[:, n:], noise], dim=1))
        of_fit = fit.dual - torch.einsum("rmn,rm->rn", influence, dual.float()).double()
        posterior = replace(
            self,
            anchor=anchor,
            dual=torch.cat([of_fit, dual], dim=1),
            tangent=slopes,
            variance=torch.cat([fit.variance, variance], dim=1),
            measured=torch.cat([self.measured, detected.to(self.measured)], dim=1),
            fit=fit,
            later=(influence, error, covariance),
        )
        vars(posterior)["feature"] = features
        return posterior

    def _robust(self, covariance: Tensor, error: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
        """Return dual coefficients and noise over weight by iteratively reweighted least squares, from one to start with.

        Errors, variances and results are (R, m), the covariance of the errors without noise is (R, m, m).
        """
        noise = self.noise_db.square()[:, None].where(variance > 0, 1.0)
        weight = (noise / variance).where(variance > 0, 1.0)
        for _ in range(100):
            used = noise / weight
            dual = torch.linalg.solve(covariance + torch.diag_embed(used), error)
            previous, weight = weight, huber_weight(used * dual, noise.sqrt(), self.huber)
            if bool(((weight - previous).abs() < NEW_WEIGHT_TOLERANCE).all()):
                break
        return dual, used.where(variance > 0, 0.0)


def uncertainty(
    kernel: Kernel, known: Tensor, receiver: Tensor, covariance: Tensor
) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """Return the function from positions to the variance that n measured positions leave open.

    The variance is that of the latent field, (m,), relative to that far from all rows, and of the path loss as a trend
    beside it, (m, R) [dB^2]. The trend is that of universal kriging (N. Cressie, "Statistics for Spatial Data", revised ed.,
    1993, section 3.4): a level or slope that the rows determine badly counts where the field does not follow from rows
    nearby.

    Args:
        kernel: Kernel of the latent field.
        known: Measured positions less the centre, (n, 3) [m]; 200 of them count.
        receiver: Positions of the receivers less the centre, (R, 3) [m].
        covariance: Covariance of level and slope of each receiver, (R, 2, 2).
    """
    (known,) = subsample(known, rows=MAX_VARIANCE_POSITIONS)
    process = GaussianProcess(kernel, known, _trend(known, receiver))
    return partial(_variances, process, receiver, covariance)  # a function that can be pickled


def _trend(position: Tensor, receiver: Tensor) -> Tensor:
    """Return the regressors of level, and of the slope of each receiver, (n, 1 + R)."""
    apart = log_distance(position, receiver)
    return torch.cat([torch.ones_like(apart[:, :1]), apart], dim=1)


def _variances(
    process: GaussianProcess, receiver: Tensor, covariance: Tensor, position: Tensor
) -> tuple[Tensor, Tensor]:
    mean, of_field = process.mean_and_variance(position)
    level, slope = (_trend(position, receiver) - mean).split([1, len(receiver)], dim=1)
    of_level, both, of_slope = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    trend = of_level * level.square() + 2 * both * level * slope + of_slope * slope.square()
    return of_field, trend.clamp_min(0)


def held_out_std(bins: Bins, kernel: Kernel, prior_db: tuple[Tensor, Tensor], covariance: Tensor) -> Tensor:
    """Return the standard deviations (n, R) [dB] that models without a bin's fold predict, before they are calibrated.

    `prior_db` are the standard deviations of latent field and noise, each (R,) [dB]; the rest is as in `uncertainty`.
    """
    (field_db, noise_db), std = prior_db, torch.empty_like(bins.rssi)
    for out, kept in each_fold(bins.fold):
        left = uncertainty(kernel, bins.position[kept], bins.receiver, covariance)
        variance, trend = left(bins.position[out])
        std[out] = (noise_db.square() + field_db.square() * variance[:, None] + trend).sqrt()
    return std
