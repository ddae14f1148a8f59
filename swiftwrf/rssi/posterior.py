"""Update of an RSSI fit with more rows: the weighted least squares that the fit ended in, bordered by the new rows.

At the end of `swiftwrf.rssi.regression.solve` the rows of one receiver have the covariance

    (slope slope^T) * covariance of the latent field + F F^T + diag(noise / weight)

with the scaled regressors F of the path loss. Its inverse is computed once. A new row then costs one product with it.
Slopes and weights of the rows of the fit stay. Those of new rows are found with all new rows together, so their order has no
effect.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.linalg.blas import ssymv
from torch import Tensor
from torch.nn import functional

from swiftwrf.gp import Kernel
from swiftwrf.rssi.head import HeadTable
from swiftwrf.rssi.path_loss import harmonics, log_distance
from swiftwrf.rssi.regression import WEIGHT_TOLERANCE, coefficient_scale, regressors
from swiftwrf.runtime.checkpoint import expect

MAX_NEW_ROWS = 256  # beyond, the weights of new rows are fixed and the inverses are computed again
TOLERANCE = WEIGHT_TOLERANCE / 100  # of these weights, so that the order of the rows does not matter


@dataclass(frozen=True, eq=False)
class FitState:
    """Weighted least squares of R receivers in n location bins at the end of a fit.

    Args:
        dual: Dual coefficients (n, R); 0 in bins that have no part in the fit.
        tangent: Slope of each head at the latent field, (n, R); 0 there.
        variance: Variance of the noise over the weight, (n, R) [dB^2]; 0 in bins that have no part in the fit.
        measured: 1 where RSSI was measured and not only limited, (n, R).
        prior_level: Prior path-loss model, RSSI at 1 m, (R,) [dBm].
        prior_slope: Its slope, (R,) [dB a decade].
        prior_std: Prior standard deviation of level [dB] and slope [dB a decade], (R, 2).
        middle: log10 of the distance at which levels are compared, (R,).
        field_variance: Prior variance of the latent field, (R,) [dB^2].
        noise_variance: Variance of one measurement, (R,) [dB^2].
    """

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

    @classmethod
    def of(cls, tensors: dict[str, Tensor], n_receivers: int, n_bins: int) -> FitState:
        """Return the state in the tensors of a file, whose names begin with `fit.`."""
        rows = ("dual", "tangent", "variance", "measured")
        sizes = {field.name: (n_bins, n_receivers) if field.name in rows else (n_receivers,) for field in fields(cls)}
        sizes["prior_std"] = (n_receivers, 2)
        expect(tensors, {f"fit.{name}": size for name, size in sizes.items()})
        return cls(**{name: tensors[f"fit.{name}"].double() for name in sizes})


@dataclass(frozen=True, eq=False)
class NewRows:
    """m rows beside those of a fit, for R receivers, float64.

    Args:
        position: Positions less the centre, (m, 3) [m].
        error: Errors of the fit, (R, m) [dB]; 0 where not detected.
        tangent: Slopes of the heads (R, m); 0 where not detected.
        variance: Variance of the noise (R, m) [dB^2]; 0 where not detected.
        influence: Effect of each new dual coefficient on those of the fit, float32 (R, m, n).
        covariance: Covariance of the errors without noise, (R, m, m).
        weight: Robust weights (R, m).
        dual: Dual coefficients (R, m).
    """

    position: Tensor
    error: Tensor
    tangent: Tensor
    variance: Tensor
    influence: Tensor
    covariance: Tensor
    weight: Tensor
    dual: Tensor

    @classmethod
    def none(cls, n_receivers: int, n_bins: int) -> NewRows:
        """Return no rows."""
        row = torch.zeros(n_receivers, 0, dtype=torch.float64)
        square, influence = row[..., None].expand(-1, 0, 0), torch.zeros(n_receivers, 0, n_bins)
        return cls(row.new_zeros(0, 3), row, row, row, influence, square, row, row)

    def solved(self, huber: float) -> NewRows:
        """Return the rows with weights and dual coefficients by iteratively reweighted least squares."""
        weight, noise = self.weight, self.variance.where(self.variance > 0, 1.0)
        for _ in range(100):
            dual = torch.linalg.solve(self.covariance + torch.diag_embed(noise / weight), self.error)
            used, missed = weight, (noise / weight * dual).abs()
            weight = (huber * noise.sqrt() / missed.clamp_min(1e-12)).clamp_max(1)
            if bool(((weight - used).abs() < TOLERANCE).all()):
                break
        return replace(self, weight=used, dual=dual)


class RssiPosterior:
    """A fit of R receivers, with more rows.

    Args:
        state: State of the fit.
        anchor: Positions of its bins less the centre, (n, 3) [m].
        receiver: Positions of the receivers less the centre, (R, 3) [m], nan where unknown.
        kernel: Kernel of the latent field.
        table: Heads of the receivers.
        huber: See `RssiConfig`.
    """

    def __init__(
        self, state: FitState, anchor: Tensor, receiver: Tensor, kernel: Kernel, table: HeadTable, huber: float
    ) -> None:
        self.state, self.anchor, self.receiver, self.kernel = state, anchor.double(), receiver, kernel
        self.table, self.huber = table, huber
        self.new = NewRows.none(len(receiver), len(anchor))

    @cached_property
    def _feature(self) -> Tensor:
        """Scaled regressors of the bins (R, n, k); 0 in bins that have no part in the fit."""
        return self._regressors(self.anchor) * (self.state.variance > 0).T[..., None]

    @cached_property
    def _inverses(self) -> list[Any]:
        """Inverse covariance of the rows of each receiver, float32 (n, n)."""
        covariance, found = self.kernel(self.anchor, self.anchor), []
        for r, feature in enumerate(self._feature):
            variance, slope = self.state.variance[:, r], self.state.tangent[:, r]
            whole = self.state.field_variance[r] * slope[:, None] * covariance * slope + feature @ feature.T
            whole.diagonal().add_(variance.where(variance > 0, 1.0))
            inverse = torch.cholesky_inverse(torch.linalg.cholesky(whole)).float()
            found.append(np.asfortranarray(inverse.numpy()))  # as BLAS reads it
        return found

    @cached_property
    def _fitted(self) -> Tensor:
        """Coefficients of the scaled regressors from the rows of the fit, (R, k, 1)."""
        return self._feature.mT @ self.state.dual.T[..., None]

    def _regressors(self, position: Tensor) -> Tensor:
        """Return the scaled regressors of level, slope and directivity at positions (m, 3), float64 (R, m, k)."""
        apart, bearing = log_distance(position, self.receiver), harmonics(position, self.receiver)
        return regressors(apart, bearing, self.state.middle, self.state.prior_std)

    @property
    def linear(self) -> Tensor:
        """Change of level at 1 m, slope and directivity from the prior path-loss model, float64 (R, k) [dB]."""
        new, dual = self._regressors(self.new.position), self.new.dual[..., None]
        coefficient = self._fitted + (new - self.new.influence.double() @ self._feature).mT @ dual
        change = coefficient[..., 0] * coefficient_scale(self.state.prior_std)
        return torch.cat([change[:, :1] - change[:, 1:2] * self.state.middle[:, None], change[:, 1:]], dim=1)

    def folded(self) -> RssiPosterior:
        """Return the fit with the new rows as rows of the fit, their weights fixed."""
        old, new = self.state, self.new
        dual = old.dual - torch.einsum("rmn,rm->nr", new.influence, new.dual.float()).double()
        state = replace(
            old,
            dual=torch.cat([dual, new.dual.T]),
            tangent=torch.cat([old.tangent, new.tangent.T]),
            variance=torch.cat([old.variance, (new.variance / new.weight).T]),
            measured=torch.cat([old.measured, (new.variance > 0).T.to(old.measured)]),
        )
        anchor = torch.cat([self.anchor, new.position])
        return RssiPosterior(state, anchor, self.receiver, self.kernel, self.table, self.huber)

    @property
    def coefficient(self) -> Tensor:
        """Coefficients of the kernel to the bins whose sum is the latent field, float64 (n, R) [dB]."""
        return self.state.field_variance * self.state.tangent * self.state.dual

    @property
    def rssi(self) -> Tensor:
        """RSSI of the bins of the fit, from fitted values and residuals, float64 (n, R) [dBm]; nan where not detected."""
        state = self.state
        latent = self.kernel(self.anchor, self.anchor) @ self.coefficient
        fitted = state.prior_level + state.prior_slope * log_distance(self.anchor, self.receiver)
        fitted = fitted + (self._feature @ self._fitted)[..., 0].T
        fitted = fitted + self.table(latent)[0] - self.table(torch.zeros_like(latent))[0]
        return (fitted + state.variance * state.dual).where(state.measured > 0, torch.nan)

    def updated(self, position: Tensor, rssi: Tensor) -> RssiPosterior:
        """Return the posterior with more rows, RSSI (m, R) [dBm], nan where not detected, at positions (m, 3) [m]."""
        if len(self.new.position) and len(self.new.position) + len(position) > MAX_NEW_ROWS:
            return self.folded().updated(position, rssi)
        state, detected = self.state, ~rssi.isnan().T  # (R, m)
        cross = self.kernel(position, self.anchor)  # (m, n)
        latent = cross @ self.coefficient  # (m, R)
        head, tangent = self.table(latent)
        feature = self._regressors(position)
        predicted = state.prior_level + state.prior_slope * log_distance(position, self.receiver)
        predicted = predicted + (feature @ self._fitted)[..., 0].T + head - self.table(torch.zeros_like(latent))[0]
        tangent = tangent.T * detected
        feature = feature * detected[..., None]
        scaled = (state.field_variance[:, None] * tangent)[..., None]  # (R, m, 1)
        # covariances with the bins, (R, m, n)
        own = scaled * cross * state.tangent.T[:, None] + feature @ self._feature.mT
        # half of each inverse is read, because its time in memory is most of the time of a row
        pairs = zip(self._inverses, own.float().numpy(), strict=True)
        influence = torch.from_numpy(np.stack([np.stack([ssymv(1.0, p, x, lower=1) for x in c]) for p, c in pairs]))
        new = NewRows(
            position=torch.cat([self.new.position, position]),
            error=torch.cat([self.new.error, (rssi - predicted).T.where(detected, 0.0)], dim=1),
            tangent=torch.cat([self.new.tangent, tangent], dim=1),
            variance=torch.cat([self.new.variance, state.noise_variance[:, None] * detected], dim=1),
            influence=torch.cat([self.new.influence, influence], dim=1),
            covariance=self.new.covariance,
            weight=functional.pad(self.new.weight, (0, len(position)), value=1.0),
            dual=self.new.dual,
        )
        prior = scaled * self.kernel(position, new.position) * new.tangent[:, None]
        prior = prior + feature @ (self._regressors(new.position) * (new.variance > 0)[..., None]).mT
        border = prior - (own.float() @ new.influence.mT).double()  # (R, m, all new)
        covariance = functional.pad(self.new.covariance, (0, len(position), 0, len(position)))
        covariance[:, -len(position) :] = border
        covariance[..., -len(position) :] = border.mT
        result = copy(self)
        result.new = replace(new, covariance=covariance).solved(self.huber)
        return result
