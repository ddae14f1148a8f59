"""The regression of one receiver, its posterior, which more rows update, and the uncertainty that the rows leave.

A receiver is a MAP estimate by iteratively reweighted least squares. The latent field c of its head is a Gaussian process;
level, slope and directivity have Gaussian priors; the error is Gaussian in the middle and linear in the tails (P. J. Huber,
1964). With the head replaced by its tangent this is weighted least squares, solved again until weights and tangent converge
(Gauss-Newton). An empty cell is an upper limit, by expectation propagation.

At its end the rows of a receiver are a Gaussian process with the kernel and the noise

    tangent_i field(x_i, x_j) tangent_j + f_i . f_j,        noise / weight_i

for the latent field and the regressors f of the path loss. Given the rows of the fit, more rows have a Gaussian
prior, which costs one product with the inverse covariance, computed once. Their robust weights are those of all of
them together, so their order has no effect. Tangents and weights of the rows of the fit stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from scipy.linalg.blas import ssymv
from torch import Tensor
from torch.nn import functional

from swiftwrf.data.splits import each_fold
from swiftwrf.errors import FitError, InputError
from swiftwrf.gp import GaussianProcess, Kernel, held_out_errors, subsample
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.detection import empty_given
from swiftwrf.rssi.head import Heads
from swiftwrf.rssi.path_loss import PathLoss, harmonics, log_distance
from swiftwrf.rssi.training import Bins, RssiTraining
from swiftwrf.runtime.threads import single_thread
from swiftwrf.runtime.validation import PositiveFloat

MAX_NEW_ROWS = 256  # beyond, the weights of new rows are fixed and the inverses are computed again


@single_thread()  # several threads add up sums in another order
def fit_receiver(number: int, data: RssiTraining, config: RssiConfig, device: torch.device) -> dict[str, Tensor]:
    """Fit one receiver by its number.

    Returns:
        Tensors by name.

        - dual (n,), tangent (n,), variance (n,), prior (2,) and root (2, 2); see `RssiPosterior`. If RSSI would rise with
          the distance, slope and its standard deviation are 0.
        - covariance (2, 2) of level and slope, given the rows.
        - held_out (f, n), predictions of all bins by the others in each of the `folds` [dBm], nan without a bin in the fit.

    Raises:
        FitError: A system that cannot be solved, for positions or values beyond any measurement.
    """
    rssi, limit, loss = data.rssi[:, number], data.limit[:, number], data.path_loss
    prior, root = torch.stack([loss.shared.level[number], loss.shared.slope[number]]), loss.root[number].clone()
    receiver, field_db = data.receiver[number, None], float(data.field_db[number])
    distance = log_distance(data.position, receiver)[:, 0]
    used = torch.cat([(~rssi.isnan() & limit.isnan()).nonzero()[:, 0], (~limit.isnan()).nonzero()[:, 0]])
    dual, tangent, variance = (torch.zeros_like(rssi) for _ in range(3))
    covariance, held_out = root @ root.T, rssi.new_full((len(data.folds), len(rssi)), torch.nan)
    if len(used):
        at, weak = data.position[used].to(device), limit[used].isnan().logical_not()
        feature = regressors(data.position[used], receiver, root[None])[0]
        noise_db = (data.noise_db[number] / data.count[used, number].clamp_min(1).sqrt()).to(device)
        detection = loss.detection
        censored = None if detection is None or not weak.any() else (detection.width, float(detection.missed[number]))
        across = field_db**2 * data.kernel(data.position.to(device), at)

        def solved() -> tuple[Tensor, ...]:
            value = (rssi.where(limit.isnan(), limit) - prior[0] - prior[1] * distance)[used].to(device)
            system = value, weak.to(device), feature.to(device), across[used], noise_db
            return solve(*system, data.heads, config.huber, censored)

        try:
            *solution, factor = solved()
            trend = feature[:, :2].to(device)
            remaining = torch.eye(2).double() - (trend.T @ torch.cholesky_solve(trend, factor)).cpu()
            covariance = root @ remaining @ root.T  # a slope that is held at 0 is as uncertain as a free one
            if float(prior[1] + root[1, 1] * (solution[0].cpu() @ feature[:, 1])) > 0:
                # at the distance where level and slope are independent
                prior = torch.stack([prior[0] - prior[1] * root[0, 1] / root[1, 1], torch.zeros(()).double()])
                root[:, 1], feature[:, 1] = 0.0, 0.0
                *solution, factor = solved()
            precision, feature = torch.cholesky_inverse(factor), regressors(data.position, receiver, root[None])[0]
            system = used, across, feature.to(device), precision
            others = [held_out_means(fold, *system, solution, data.heads).cpu() for fold in data.folds]
            held_out = prior[0] + prior[1] * distance + torch.stack(others)
        except torch.linalg.LinAlgError as reason:  # type: ignore[attr-defined]
            raise FitError(
                f"the RSSI fit of receiver {data.receiver_names[number]!r} broke ({reason}); are its values sane?"
            ) from None
        dual[used], tangent[used], variance[used], _ = (x.cpu() for x in solution)
    rows = {"dual": dual, "tangent": field_db * tangent, "variance": variance, "held_out": held_out}
    return rows | {"prior": prior, "root": root, "covariance": covariance}


def held_out_means(
    fold: Tensor,
    used: Tensor,
    across: Tensor,
    feature: Tensor,
    precision: Tensor,
    solution: Sequence[Tensor],
    heads: Heads,
) -> Tensor:
    """Return how the bins of all other folds predict RSSI less the prior path loss, (n,) [dB].

    Args:
        fold: Fold of each bin, (n,).
        used: Numbers of the u bins of the fit.
        across: Covariance of the latent field between all bins and those of the fit, (n, u) [dB^2].
        feature: Regressors of all bins, (n, k).
        precision: Inverse covariance of the bins of the fit, (u, u).
        solution: Dual coefficients and slopes of the tangent, each (u,), of `solve`.
        heads: Head of the receiver.
    """
    (dual, slope, *_), predicted = solution, torch.empty_like(across[:, 0])
    for out, _ in each_fold(fold):
        part = torch.isin(used, out).nonzero()[:, 0].to(dual.device)
        others = dual - precision[:, part] @ held_out_errors(precision, dual[:, None], part)[:, 0]
        latent = across[out] @ (slope * others)
        predicted[out] = feature[out] @ (feature[used].T @ others) + heads(latent[:, None])[0][:, 0]
    return predicted


def regressors(position: Tensor, receiver: Tensor, root: Tensor, directivity_std_db: float = 2.0) -> Tensor:
    """Return the regressors of level, slope and directivity with standard normal coefficients, float64 (R, n, 10).

    Args:
        position: Positions (n, 3) [m].
        receiver: Positions of the receivers (R, 3) [m].
        root: See `RssiPosterior`.
        directivity_std_db: Prior standard deviation of each harmonic of a receiver's antenna and surroundings [dB]. Not
            studied.
    """
    distance = log_distance(position, receiver).T
    trend = torch.stack([torch.ones_like(distance), distance], dim=-1) @ root
    return torch.cat([trend, directivity_std_db * harmonics(position, receiver).transpose(0, 1)], dim=-1)


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
    heads: Heads,
    huber: float,
    censored: tuple[float, float] | None = None,
    *,
    damping: float = 0.7,
    acceleration: float = 1.4,
    weight_tolerance: float = 1e-2,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Fit value = F b + head(c) + noise in n bins, with b standard normal and c of covariance K.

    Three steps alternate until they change nothing.

    1. Gauss-Newton. The head is replaced by its tangent at c, which has the slope s. Then value + s c - head(c) has the
       covariance S = s K s^T + F F^T + V, the dual coefficients are a = S^-1 (value + s c - head(c)), and c = K s a.
    2. Huber's loss. The residuals are V a. A value has the weight w = min(1, huber noise_db / |V a|) and V = noise_db^2 / w.
    3. Expectation propagation (C. E. Rasmussen and C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006,
       section 3.6). An upper limit enters as a value t and a variance V that match the moments of its likelihood. All other
       bins predict it with the mean t - a / Q and the variance 1 / Q - V, where Q is its diagonal element of S^-1.

    Args:
        value: RSSI, or its upper limit, less the prior mean, (n,) [dB].
        weak: Whether a value is an upper limit, bool (n,), true at the last values alone.
        feature: Regressors F, (n, k).
        covariance: Covariance K of the latent field c, (n, n) [dB^2].
        noise_db: Standard deviation of the noise, (n,) [dB].
        heads: Head of the receiver.
        huber: See `RssiConfig`.
        censored: Width of the limits [dB] and fraction of random misses. None without limits.
        damping: Fraction of each change of an upper limit that is applied, below 1 so that neighbouring limits converge.
            Not studied.
        acceleration: Power of the factor by which a weight changes, above 1 because weights approach their limits from one
            side. With 1.4 the systems of ts-tut2 and of a simulated survey need 20 % fewer steps.
        weight_tolerance: Largest change of a weight, from 0 to 1, at the end. With 0.003 held-out errors of ts-tut2,
            dae-2025 and ts-ujib1 differ by less than 0.0002 dB.

    Returns:
        Dual coefficients a (n,); the slope s of the tangent (n,); the variance V (n,) [dB^2]; the values, with those in
        place of limits, (n,) [dB]; the Cholesky factor of S, (n, n).
    """
    weight, latent, noise = torch.ones_like(value), torch.zeros_like(value), noise_db.square()
    limit, prior_variance = value[weak], (covariance.diagonal() + feature.square().sum(dim=1))[weak]
    n_known, vague = len(value) - len(limit), 1e6  # variance of a limit without effect [dB^2]
    step, last_change = torch.ones_like(value), torch.zeros_like(value)

    def moments(mean: Tensor, variance: Tensor) -> Tensor:
        return variance.new_zeros(2, 0) if censored is None else _site(mean, variance, limit, noise[weak], censored)

    def replaced(site: Tensor) -> Tensor:
        return value.masked_scatter(weak, (site[1] / site[0].clamp_min(1e-9)).where(site[0] > 1 / vague, 0.0))

    site = moments(torch.zeros_like(limit), prior_variance)  # precision, and precision times value, in place of limits
    for _ in range(30):
        head, slope = (x[:, 0] for x in heads(latent[:, None]))
        variance = (noise / weight).masked_scatter(weak, 1 / site[0].clamp_min(1 / vague))
        total = covariance_of(covariance, (slope, feature), (slope, feature))
        total.diagonal().add_(variance)
        factor, target = torch.linalg.cholesky(total), replaced(site)
        dual = torch.cholesky_solve((target + slope * latent - head)[:, None], factor)[:, 0]
        change = covariance @ (slope * dual) - latent
        # a change of the other sign: this latent value oscillates, because its head bends
        step = (step / 2).where(change * last_change < 0, (1.5 * step).clamp_max(1))
        latent, last_change = latent + step * change, change
        following = huber_weight(variance * dual, noise_db, huber).masked_fill(weak, 1.0)
        settled = float((following - weight).abs().max()) < weight_tolerance
        weight = (weight * (following / weight) ** acceleration).clamp_max(1)
        if censored is not None:
            # the last rows of S^-1 follow from those of its factor alone
            diagonal = torch.cholesky_inverse(factor[n_known:, n_known:]).diagonal()
            others = target[weak] - dual[weak] / diagonal, (1 / diagonal - variance[weak]).clamp_min(1e-6)
            site = site + damping * (moments(*others) - site)
            settled &= float(((replaced(site) - target)[weak] * site[0].sqrt()).abs().mean()) < 0.02
        if settled and float(change.abs().mean()) < 0.1:
            break
    return dual, slope, variance, target, factor


def _site(mean: Tensor, variance: Tensor, limit: Tensor, noise: Tensor, censored: tuple[float, float]) -> Tensor:
    """Return precision and precision times value, (2, n), that match the likelihood of empty cells; 0 if not concave.

    The log-likelihood has the derivatives d and e < 0 by the mean m of a power of variance v. The precision is
    -e / (1 + e v). Precision times value is (d - m e) / (1 + e v).

    Args:
        mean: Mean of each power by all others (n,) [dB].
        variance: Its variance without noise (n,) [dB^2].
        limit: Upper limits (n,) [dB].
        noise: Variance of the noise (n,) [dB^2].
        censored: Width of the limits [dB] and fraction of random misses.
    """
    width, missed = censored
    std = (variance + noise + width**2).sqrt()
    z = (limit - mean) / std
    first = -empty_given(z, torch.tensor(missed, dtype=torch.float64, device=z.device))[0] / std
    second = z * first / std - first.square()
    remaining = 1 + second * variance
    concave = (second < 0) & (remaining > 1e-3)
    return (torch.stack([-second, first - mean * second]) / remaining).where(concave, 0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class RssiPosterior:
    """Gaussian processes of R receivers, given n rows.

    Args:
        kernel: Kernel of the latent field.
        heads: Heads of the receivers.
        huber: See `RssiConfig`.
        receiver: Positions of the receivers less the centre, (R, 3) [m], nan where unknown.
        position: Positions of the rows less the centre, (n, 3) [m].
        dual: Dual coefficients (R, n); 0 in rows that have no part in the fit.
        tangent: Slope of each head at the latent field, times the prior standard deviation of the field, (R, n) [dB].
        variance: Variance of the noise over the weight, (R, n) [dB^2]; 0 in rows that have no part in the fit.
        measured: 1 where RSSI was measured and not only limited, (R, n).
        prior: Prior path-loss model, RSSI at 1 m [dBm] and slope [dB a decade], (R, 2).
        root: A factor of their prior covariance, root @ root^T, (R, 2, 2).
        field_db: Prior standard deviation of the latent field, (R,) [dB].
        noise_db: Standard deviation of one measurement, (R,) [dB].
        added: Last rows, which were added to the fit of all others. Defaults to none. A file does not contain it.
    """

    kernel: Kernel
    heads: Heads
    huber: PositiveFloat
    receiver: Annotated[Tensor, "float64 r 3 nan"]
    position: Annotated[Tensor, "float64 n 3"]
    dual: Annotated[Tensor, "float64 r n"]
    tangent: Annotated[Tensor, "float64 r n"]
    variance: Annotated[Tensor, "float64 r n"]
    measured: Annotated[Tensor, "float64 r n"]
    prior: Annotated[Tensor, "float64 r 2"]
    root: Annotated[Tensor, "float64 r 2 2"]
    field_db: Annotated[Tensor, "float64 r"]
    noise_db: Annotated[Tensor, "float64 r"]
    added: AddedRows | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        if len(self.heads.rendered) not in (1, len(self.receiver)):
            raise InputError(f"expected one head, or one for each of {len(self.receiver)} receivers")

    @cached_property
    def feature(self) -> Tensor:
        """Regressors (R, n, 10); 0 in rows that have no part in the fit."""
        return regressors(self.position, self.receiver, self.root) * (self.variance > 0)[..., None]

    @cached_property
    def _inverses(self) -> list[Any]:
        """Inverse covariance of the rows of each receiver, float32 (n, n)."""
        latent, inverses = self.kernel(self.position, self.position), []
        for tangent, feature, variance in zip(self.tangent, self.feature, self.variance, strict=True):
            covariance = covariance_of(latent, (tangent, feature), (tangent, feature))
            covariance.diagonal().add_(variance.where(variance > 0, 1.0))
            inverse = torch.cholesky_inverse(torch.linalg.cholesky(covariance)).float()
            inverses.append(np.asfortranarray(inverse.numpy()))  # as BLAS reads it
        return inverses

    @cached_property
    def _linear(self) -> Tensor:
        """Coefficients of the regressors, (R, 10, 1)."""
        return self.feature.mT @ self.dual[..., None]

    @property
    def path_loss(self) -> PathLoss:
        """Path-loss model of each receiver, (R,)."""
        return PathLoss(*(self.prior + (self.root @ self._linear[:, :2])[..., 0]).T)

    @cached_property
    def trend(self) -> GaussianProcess:
        """Process for the standard deviation of predictions; see `predictive_std`."""
        return trend_process(self.kernel, self.position, self.receiver)

    @cached_property
    def own_trends(self) -> list[GaussianProcess]:
        """Process of each receiver of the positions where it was measured; see `trend`."""
        work = zip(self.measured, self.receiver[:, None], strict=True)
        return [trend_process(self.kernel, self.position[seen > 0], receiver) for seen, receiver in work]

    @cached_property
    def coefficient(self) -> Tensor:
        """Coefficients of the kernel to the rows whose sum is the latent field, float64 (n, R) [dB]."""
        return (self.field_db[:, None] * self.tangent * self.dual).T.contiguous()

    @property
    def rssi(self) -> Tensor:
        """RSSI of the rows, from fitted values and residuals, float64 (n, R) [dBm]; nan where not detected."""
        fitted = self.at(self.position, self.kernel(self.position, self.position))[0]
        return fitted + (self.variance * self.dual).where(self.measured > 0, torch.nan).T

    def at(self, position: Tensor, cross: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return RSSI (m, R) [dBm], tangent (R, m) [dB] and regressors (R, m, 10) at positions (m, 3) [m].

        `cross` are the values of the kernel between them and the rows, (m, n), in the precision of the field.
        """
        head, derivative = self.heads(cross @ self.coefficient.to(cross))
        feature = regressors(position, self.receiver, self.root)
        prior = PathLoss(*self.prior.T)(log_distance(position, self.receiver))
        return prior + (feature @ self._linear)[..., 0].T + head, self.field_db[:, None] * derivative.T, feature

    def updated(self, position: Tensor, rssi: Tensor) -> RssiPosterior:
        """Return the posterior with more rows, RSSI (m, R) [dBm], nan where not detected, at positions (m, 3) [m]."""
        n_receivers, n_new, added = len(self.receiver), len(position), self.added
        if added is None or added.error.shape[1] + n_new > MAX_NEW_ROWS:
            fit = self if added is None else replace(self)
            none = self.dual.new_zeros(n_receivers, 0)
            added = AddedRows(
                fit, torch.zeros(n_receivers, 0, len(self.position)), none, none[..., None].expand(-1, 0, 0)
            )
        fit, n = added.fit, len(added.fit.position)
        detected, cross = ~rssi.isnan().T, self.kernel(position, fit.position)
        mean, tangent, feature = fit.at(position, cross)
        new = tangent * detected, feature * detected[..., None]
        # condition on the rows of the fit
        with_fit = covariance_of(cross, new, (fit.tangent, fit.feature)).float()
        # half of each inverse is read, because its time in memory is most of the time of a row
        pairs = zip(fit._inverses, with_fit.numpy(), strict=True)
        influence = torch.from_numpy(np.stack([np.stack([ssymv(1.0, p, x, lower=1) for x in c]) for p, c in pairs]))
        influence = torch.cat([added.influence, influence], dim=1)
        error = torch.cat([added.error, (rssi - mean).T.where(detected, 0.0)], dim=1)
        noise = fit.noise_db.square()[:, None] * detected
        positions = torch.cat([self.position, position])
        tangents, features = torch.cat([self.tangent, new[0]], dim=1), torch.cat([self.feature, new[1]], dim=1)
        border = covariance_of(self.kernel(position, positions[n:]), new, (tangents[:, n:], features[:, n:]))
        border = border - (with_fit @ influence.mT).double()
        covariance = functional.pad(added.covariance, (0, n_new, 0, n_new))
        covariance[:, -n_new:], covariance[..., -n_new:] = border, border.mT
        dual, variance = self._robust(covariance, error, torch.cat([self.variance[:, n:], noise], dim=1))
        of_fit = fit.dual - torch.einsum("rmn,rm->rn", influence, dual.float()).double()
        posterior = replace(
            self,
            position=positions,
            dual=torch.cat([of_fit, dual], dim=1),
            tangent=tangents,
            variance=torch.cat([fit.variance, variance], dim=1),
            measured=torch.cat([self.measured, detected.to(self.measured)], dim=1),
        )
        vars(posterior).update(feature=features, added=AddedRows(fit, influence, error, covariance))
        return posterior

    def _robust(
        self, covariance: Tensor, error: Tensor, variance: Tensor, weight_tolerance: float = 3e-5
    ) -> tuple[Tensor, Tensor]:
        """Return dual coefficients and noise over weight by iteratively reweighted least squares, from one to start with.

        Errors, variances and results are (R, m), the covariance of the errors without noise is (R, m, m). The tolerance of
        the weights is small, so that the order of rows has no effect.
        """
        used = variance > 0
        noise = self.noise_db.square()[:, None].where(used, 1.0)
        weight = (noise / variance).where(used, 1.0)
        for _ in range(100):
            variance = noise / weight
            dual = torch.linalg.solve(covariance + torch.diag_embed(variance), error)
            previous, weight = weight, huber_weight(variance * dual, noise.sqrt(), self.huber)
            if bool(((weight - previous).abs() < weight_tolerance).all()):
                break
        return dual, variance.where(used, 0.0)


class AddedRows(NamedTuple):
    """The last m rows of a posterior, which were added to a fit of n rows.

    Args:
        fit: Posterior of the n rows, whose weights are fixed.
        influence: Effect of the m dual coefficients on those of the fit, float32 (R, m, n).
        error: Measurements less predictions of the fit, (R, m) [dB].
        covariance: Covariance of these errors without noise, (R, m, m).
    """

    fit: RssiPosterior
    influence: Tensor
    error: Tensor
    covariance: Tensor


def trend_process(kernel: Kernel, known: Tensor, receiver: Tensor, max_positions: int = 200) -> GaussianProcess:
    """Return the process of a field and of the trend of its path loss at measured positions; see `predictive_std`.

    Args:
        kernel: Kernel of the latent field.
        known: Measured positions less the centre, (n, 3) [m].
        receiver: Positions of the receivers less the centre, (R, 3) [m].
        max_positions: Measured positions that determine where the field is known. Not studied.
    """
    (known,) = subsample(known, rows=max_positions)
    return GaussianProcess(kernel, known, _trend(known, receiver))


def _trend(position: Tensor, receiver: Tensor) -> Tensor:
    """Return the regressors of level, and of the slope of each receiver, (n, 1 + R)."""
    distance = log_distance(position, receiver)
    return torch.cat([torch.ones_like(distance[:, :1]), distance], dim=1)


def predictive_std(
    process: GaussianProcess,
    receiver: Tensor,
    position: Tensor,
    prior_db: tuple[Tensor, Tensor],
    covariance: Tensor,
) -> Tensor:
    """Return the standard deviation of a measurement (m, R) [dB] at positions (m, 3) less the centre [m].

    The path loss has the variance of a trend in universal kriging (N. Cressie, "Statistics for Spatial Data", revised ed.,
    1993, section 3.4): a level or slope that the rows determine badly counts where no rows nearby determine the field.

    Args:
        process: Process of the measured positions, see `trend_process`.
        receiver: Positions of the receivers less the centre, (R, 3) [m].
        position: Positions.
        prior_db: Standard deviations of the field far from all rows, and of a measurement about it, each (R,) [dB].
        covariance: Covariance of level and slope of each receiver, (R, 2, 2).
    """
    (field_db, noise_db), (mean, variance) = prior_db, process.mean_and_variance(position)
    level, slope = (_trend(position, receiver) - mean).split([1, len(receiver)], dim=1)
    of_level, both, of_slope = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    trend = of_level * level.square() + 2 * both * level * slope + of_slope * slope.square()
    std: Tensor = (noise_db.square() + field_db.square() * variance[:, None] + trend.clamp_min(0)).sqrt()
    return std


def held_out_std(
    bins: Bins, fold: Tensor, kernel: Kernel, prior_db: tuple[Tensor, Tensor], covariance: Tensor
) -> Tensor:
    """Return the standard deviations (n, R) [dB] that models without a bin's fold (n,) predict; see `predictive_std`."""
    std = torch.empty_like(bins.rssi)
    for out, kept in each_fold(fold):
        process = trend_process(kernel, bins.position[kept], bins.receiver)
        std[out] = predictive_std(process, bins.receiver, bins.position[out], prior_db, covariance)
    return std
