"""The posterior of fitted receivers, which more rows update, and the uncertainty that the rows leave.

At the end of a fit the rows of a receiver are a Gaussian process with the kernel and the noise

    tangent_i field(x_i, x_j) tangent_j + f_i . f_j,        noise / weight_i

for the latent field and the regressors f of the path loss. Given the rows of the fit, more rows have a Gaussian
prior, which costs one product with the inverse covariance, computed once. Their robust weights are those of all of
them together, so their order has no effect. Tangents and weights of the rows of the fit stay.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from scipy.linalg.blas import ssymv
from torch import Tensor
from torch.nn import functional

from swiftwrf.data.splits import each_fold
from swiftwrf.errors import InputError
from swiftwrf.gp import GaussianProcess, Kernel, subsample
from swiftwrf.rssi.head import Heads
from swiftwrf.rssi.path_loss import PathLoss, harmonics, log_distance
from swiftwrf.rssi.training import Bins
from swiftwrf.runtime.validation import PositiveFloat

MAX_NEW_ROWS = 256  # beyond, the weights of new rows are fixed and the inverses are computed again


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
