"""The posterior of an RSSI fit, and its update with more rows.

At the end of `swiftwrf.rssi.regression.solve` the rows of one receiver are a Gaussian process with the kernel and the noise

    tangent_i field(x_i, x_j) tangent_j + f_i . f_j,        noise / weight_i

for the latent field and the scaled regressors f of the path loss. Given the rows of the fit, more rows have a Gaussian
prior, which costs one product with the inverse covariance, computed once. Their robust weights are found with all of them
together, so their order has no effect. Tangents and weights of the rows of the fit stay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.linalg.blas import ssymv
from torch import Tensor
from torch.nn import functional

from swiftwrf.gp import Kernel
from swiftwrf.rssi.head import HeadTable
from swiftwrf.rssi.path_loss import PathLoss, log_distance
from swiftwrf.rssi.regression import WEIGHT_TOLERANCE, coefficient_scale, covariance_of, huber_weight, regressors

MAX_NEW_ROWS = 256  # beyond, the weights of new rows are fixed and the inverses are computed again
TOLERANCE = WEIGHT_TOLERANCE / 100  # of these weights, so that the order of the rows does not matter


@dataclass(frozen=True, eq=False)
class RssiPosterior:
    """Gaussian processes of R receivers, given n rows.

    Args:
        receiver: Positions of the receivers less the centre, (R, 3) [m], nan where unknown.
        kernel: Kernel of the latent field.
        table: Heads of the receivers.
        huber: See `RssiConfig`.
        anchor: Positions of the rows less the centre, float64 (n, 3) [m].
        dual: Dual coefficients (R, n); 0 in rows that have no part in the fit.
        tangent: Slope of each head at the latent field, (R, n); 0 there.
        variance: Variance of the noise over the weight, (R, n) [dB^2]; 0 in rows that have no part in the fit.
        measured: 1 where RSSI was measured and not only limited, (R, n).
        prior_level: Prior path-loss model, RSSI at 1 m, (R,) [dBm].
        prior_slope: Its slope, (R,) [dB a decade].
        prior_std: Prior standard deviation of level [dB] and slope [dB a decade], (R, 2).
        middle: log10 of the distance at which levels are compared, (R,).
        field_variance: Prior variance of the latent field, (R,) [dB^2].
        noise_variance: Variance of one measurement, (R,) [dB^2].
        feature: Scaled regressors (R, n, 10); 0 in rows that have no part in the fit. Defaults to those of the anchors.
        fit: Posterior of the first n - m rows, whose weights are fixed. Defaults to all rows.
        later: Of the m rows after those: the effect of their dual coefficients on those of the fit, float32 (R, m, n - m),
            the errors of the fit, (R, m) [dB], and the covariance of these errors without noise, (R, m, m).
    """

    receiver: Tensor
    kernel: Kernel
    table: HeadTable
    huber: float
    anchor: Tensor
    dual: Tensor
    tangent: Tensor
    variance: Tensor
    measured: Tensor
    prior_level: Tensor
    prior_slope: Tensor
    prior_std: Tensor
    middle: Tensor
    field_variance: Tensor
    noise_variance: Tensor
    feature: Tensor = None  # type: ignore[assignment]
    fit: RssiPosterior | None = None
    later: tuple[Tensor, Tensor, Tensor] | None = None

    def __post_init__(self) -> None:
        if self.feature is None:
            feature = regressors(self.anchor, self.receiver, self.middle, self.prior_std)
            object.__setattr__(self, "feature", feature * (self.variance > 0)[..., None])

    @staticmethod
    def shapes(n_receivers: int, n_rows: int) -> dict[str, tuple[int, ...]]:
        """Return the shape of every tensor that a file contains."""
        found: dict[str, tuple[int, ...]] = {"anchor": (n_rows, 3), "prior_std": (n_receivers, 2)}
        found |= dict.fromkeys(("dual", "tangent", "variance", "measured"), (n_receivers, n_rows))
        per_receiver = ("prior_level", "prior_slope", "middle", "field_variance", "noise_variance")
        return found | dict.fromkeys(per_receiver, (n_receivers,))

    @cached_property
    def _inverses(self) -> list[Any]:
        """Inverse covariance of the rows of each receiver, float32 (n, n)."""
        field, found = self.kernel(self.anchor, self.anchor), []
        for r, feature in enumerate(self.feature):
            rows = self.tangent[r], feature
            whole = covariance_of(self.field_variance[r] * field, rows, rows)
            whole.diagonal().add_(self.variance[r].where(self.variance[r] > 0, 1.0))
            inverse = torch.cholesky_inverse(torch.linalg.cholesky(whole)).float()
            found.append(np.asfortranarray(inverse.numpy()))  # as BLAS reads it
        return found

    @property
    def linear(self) -> Tensor:
        """Change of level at 1 m, slope and directivity from the prior path-loss model, float64 (R, 10) [dB]."""
        change = self._linear * coefficient_scale(self.prior_std)
        return torch.cat([change[:, :1] - change[:, 1:2] * self.middle[:, None], change[:, 1:]], dim=1)

    @cached_property
    def _linear(self) -> Tensor:
        """Coefficients of the scaled regressors, (R, 10)."""
        return (self.feature.mT @ self.dual[..., None])[..., 0]

    @property
    def coefficient(self) -> Tensor:
        """Coefficients of the kernel to the rows whose sum is the latent field, float64 (n, R) [dB]."""
        return (self.field_variance[:, None] * self.tangent * self.dual).T

    @property
    def rssi(self) -> Tensor:
        """RSSI of the rows, from fitted values and residuals, float64 (n, R) [dBm]; nan where not detected."""
        fitted = self._at(self.anchor, self.kernel(self.anchor, self.anchor))[0]
        return (fitted + self.variance * self.dual).where(self.measured > 0, torch.nan).T

    def _at(self, position: Tensor, cross: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return RSSI (R, m) [dBm], slope of the head (R, m) and regressors (R, m, 10) at positions (m, 3) [m].

        `cross` are the values of the kernel between them and the rows, (m, n).
        """
        head, tangent = self.table(cross @ self.coefficient)
        feature = regressors(position, self.receiver, self.middle, self.prior_std)
        prior = PathLoss(self.prior_level, self.prior_slope)(log_distance(position, self.receiver))
        return (prior + head).T + (feature @ self._linear[..., None])[..., 0], tangent.T, feature

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
        field = fit.field_variance[:, None, None]
        own = covariance_of(field * cross, new, (fit.tangent, fit.feature))
        # half of each inverse is read, because its time in memory is most of the time of a row
        pairs = zip(fit._inverses, own.float().numpy(), strict=True)
        influence = torch.from_numpy(np.stack([np.stack([ssymv(1.0, p, x, lower=1) for x in c]) for p, c in pairs]))
        influence = torch.cat([later[0], influence], dim=1)
        error = torch.cat([later[1], (rssi.T - mean).where(detected, 0.0)], dim=1)
        noise = fit.noise_variance[:, None] * detected
        rows: dict[str, Any] = {
            "anchor": torch.cat([self.anchor, position]),
            "tangent": torch.cat([self.tangent, new[0]], dim=1),
            "feature": torch.cat([self.feature, new[1]], dim=1),
            "variance": torch.cat([self.variance, noise], dim=1),
            "measured": torch.cat([self.measured, detected.to(self.measured)], dim=1),
        }
        n = len(fit.anchor)
        prior = self.kernel(position, rows["anchor"][n:])
        border = covariance_of(field * prior, new, (rows["tangent"][:, n:], rows["feature"][:, n:]))
        border = border - (own.float() @ influence.mT).double()
        covariance = functional.pad(later[2], (0, n_new, 0, n_new))
        covariance[:, -n_new:], covariance[..., -n_new:] = border, border.mT
        dual, rows["variance"][:, n:] = self._robust(covariance, error, rows["variance"][:, n:])
        of_fit = fit.dual - torch.einsum("rmn,rm->rn", influence, dual.float()).double()
        rows["dual"] = torch.cat([of_fit, dual], dim=1)
        return replace(self, **rows, fit=fit, later=(influence, error, covariance))

    def _robust(self, covariance: Tensor, error: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
        """Return dual coefficients and noise over weight by iteratively reweighted least squares, from one to start with.

        Errors, variances and results are (R, m), the covariance of the errors without noise is (R, m, m).
        """
        noise = self.noise_variance[:, None].where(variance > 0, 1.0)
        weight = (noise / variance).where(variance > 0, 1.0)
        for _ in range(100):
            used = noise / weight
            dual = torch.linalg.solve(covariance + torch.diag_embed(used), error)
            previous, weight = weight, huber_weight(used * dual, noise.sqrt(), self.huber)
            if bool(((weight - previous).abs() < TOLERANCE).all()):
                break
        return dual, used.where(variance > 0, 0.0)
