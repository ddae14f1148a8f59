"""Likelihoods of RSSI by the radio maps of all receivers: values, detections, and similar fingerprints."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from swiftwrf.locate.residuals import DEGREES
from swiftwrf.models.prediction import Prediction

MIN_STD_DB = 0.5
SHRINKAGES = (0.0, 0.1, 0.3, 0.6, 1.0)  # of a correlation matrix towards the identity, that are compared
PAIRS = 10.0  # rows of a pair of receivers after which its correlation counts half
CHUNK = 2**24  # values of receivers x candidates x rows at a time


@dataclass(frozen=True, eq=False)
class RssiMaps:
    """Predicted RSSI at candidate positions.

    Args:
        mean, std: float32 (m, R) [dBm], [dB].
    """

    mean: Tensor
    std: Tensor

    @classmethod
    def of(cls, prediction: Prediction) -> RssiMaps:
        """Take the maps from a prediction with standard deviations."""
        assert prediction.std is not None
        return cls(prediction.mean.float(), prediction.std.float().clamp_min(MIN_STD_DB))


@dataclass(frozen=True, eq=False)
class ValueLikelihood:
    """Student likelihood of the values, whose errors are correlated between receivers (device, body, weather).

    Args:
        correlation: Correlation of standardised residuals between receivers, float64 (R, R).
        degrees: Degrees of freedom; infinite for a Gaussian.
    """

    correlation: Tensor
    degrees: float

    name = "values"

    @classmethod
    def fit(cls, residual: Tensor) -> ValueLikelihood:
        """Fit to standardised held-out residuals (n, R), NaN if not detected; cross-validation chooses the shape."""
        fold = torch.arange(len(residual)) % 2
        best, found = -math.inf, cls(torch.eye(residual.shape[1], dtype=torch.float64), math.inf)
        for shrinkage in SHRINKAGES:
            halves = [cls(_correlation(residual[fold == part], shrinkage), math.inf) for part in (0, 1)]
            distances = [half._distance(residual[fold != part]) for part, half in enumerate(halves)]
            for degrees in DEGREES:
                score = sum(float(_density(*distance, degrees).sum()) for distance in distances)
                if score > best:
                    best, found = score, cls(_correlation(residual, shrinkage), degrees)
        return found

    def _distance(self, residual: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return squared whitened distances, log-determinants and numbers of values of residual rows (n, R)."""
        maps = RssiMaps(torch.zeros(1, residual.shape[1]), torch.ones(1, residual.shape[1]))
        return tuple(part[:, 0] for part in self._parts(maps, residual.float()))  # type: ignore[return-value]

    def _parts(self, maps: RssiMaps, rssi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        n, m = len(rssi), len(maps.mean)
        distance, determinant = torch.zeros(n, m), torch.zeros(n, m)
        detected = ~rssi.isnan()
        log_std = maps.std.log()
        patterns, owner = detected.unique(dim=0, return_inverse=True)
        for number, pattern in enumerate(patterns):
            rows, columns = (owner == number).nonzero()[:, 0], pattern.nonzero()[:, 0]
            if not len(columns):
                continue
            root = torch.linalg.cholesky(self.correlation[columns][:, columns])
            whitening = torch.linalg.inv(root).T.float()
            determinant[rows] = log_std[:, columns].sum(dim=1) + float(root.diagonal().log().sum())
            # (y - mean) / std @ W, expanded, so that nothing of size rows x candidates x receivers is held
            scaled = maps.mean[:, columns] / maps.std[:, columns]
            for some in rows.split(max(1, CHUNK // (m * len(columns)))):
                error = rssi[some][:, columns][:, None] / maps.std[:, columns] - scaled
                distance[some] = (error @ whitening).square().sum(dim=2)
        return distance, determinant, detected.sum(dim=1, keepdim=True).float()

    def sample(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        """Sample standardised errors, float64 (*shape, R)."""
        white = torch.randn(*shape, len(self.correlation), generator=generator, dtype=torch.float64)
        noise: Tensor = white @ torch.linalg.cholesky(self.correlation).T
        if math.isinf(self.degrees):
            return noise
        # a Student variable is a Gaussian one over the root of a scaled chi-squared one
        rng = np.random.default_rng(int(torch.randint(2**31, (), generator=generator)))
        chi_squared = torch.from_numpy(rng.chisquare(self.degrees, shape))
        scale: Tensor = (chi_squared / self.degrees).sqrt()
        return noise / scale[..., None]

    def log_likelihood(self, maps: RssiMaps, rssi: Tensor) -> Tensor:
        """Return log-likelihoods (n, m) of RSSI (n, R) [dBm] at candidates with maps (m, R)."""
        return _density(*self._parts(maps, rssi.float()), self.degrees)


def _density(distance: Tensor, determinant: Tensor, count: Tensor, degrees: float) -> Tensor:
    if math.isinf(degrees):
        return -distance / 2 - determinant - count / 2 * math.log(2 * math.pi)
    constant = torch.lgamma((degrees + count) / 2) - math.lgamma(degrees / 2) - count / 2 * math.log(degrees * math.pi)
    return constant - determinant - (degrees + count) / 2 * torch.log1p(distance / degrees)


def _correlation(residual: Tensor, shrinkage: float) -> Tensor:
    """Return the shrunk correlation matrix (R, R) of standardised residuals (n, R) with gaps."""
    known = (~residual.isnan()).double()
    filled = residual.double().nan_to_num()
    count = known.T @ known
    product = (filled.T @ filled) / count.clamp_min(1)
    product = product * count / (count + PAIRS)  # pairs of few common rows count less
    scale = product.diagonal().clamp_min(0.25).sqrt()
    own = (product / scale / scale[:, None]).clamp(-0.99, 0.99)
    shape = (1 - shrinkage) * own
    value, vector = torch.linalg.eigh(shape - torch.diag(shape.diagonal()) + torch.eye(len(own), dtype=own.dtype))
    positive: Tensor = (vector * value.clamp_min(0.05)) @ vector.T * scale * scale[:, None]
    return positive


@dataclass(frozen=True)
class DetectionLikelihood:
    """Likelihood of which receivers detect the transmitter: logistic in the predicted RSSI, with losses at any power.

    Args:
        threshold: RSSI at which half of the packets are detected [dBm].
        width: Width of the transition [dB].
        loss: Probability that a strong packet is lost.
    """

    threshold: float
    width: float
    loss: float

    name = "detections"

    @classmethod
    def fit(cls, mean: Tensor, detected: Tensor) -> DetectionLikelihood:
        """Fit to predicted RSSI (n, R) [dBm] and detections, bool (n, R), of held-out rows."""
        m, d = mean.double().flatten(), detected.flatten()

        def loss(raw: NDArray[np.float64]) -> float:
            return -float(cls._of(raw)._log_probability(m, d).mean())

        start = np.array([float(m.quantile(0.1)), 1.5, -2.0])
        return cls._of(minimize(loss, start, method="Nelder-Mead", options={"maxiter": 300}).x)

    @classmethod
    def _of(cls, raw: NDArray[np.float64]) -> DetectionLikelihood:
        return cls(float(raw[0]), float(np.exp(np.clip(raw[1], -1, 4))), float(0.9 / (1 + np.exp(-raw[2]))))

    def probability(self, mean: Tensor) -> Tensor:
        """Return the probability of a detection for each predicted RSSI [dBm], of the same shape."""
        return (1 - self.loss) * torch.sigmoid((mean - self.threshold) / self.width)

    def _log_probability(self, mean: Tensor, detected: Tensor) -> Tensor:
        chance = self.probability(mean).clamp(1e-4, 1 - 1e-4)
        return torch.where(detected, chance.log(), (-chance).log1p())

    def log_likelihood(self, maps: RssiMaps, rssi: Tensor) -> Tensor:
        """Return log-likelihoods (n, m) of the detections in RSSI (n, R) at candidates with maps (m, R)."""
        chance = self.probability(maps.mean).clamp(1e-4, 1 - 1e-4)
        detected = (~rssi.isnan()).float()
        return detected @ chance.log().T + (1 - detected) @ (-chance).log1p().T


@dataclass(frozen=True, eq=False)
class FingerprintLikelihood:
    """Student distribution of the position around the weighted mean of the k most similar training rows.

    Args:
        position: Training positions, float64 (n, 3) [m].
        rssi: Training RSSI with a value for what is not detected, float32 (n, R) [dBm].
        floor: That value [dBm].
        k: Number of neighbours.
        scale_m: Scale of the distribution along each axis [m].
        degrees: Degrees of freedom.
    """

    position: Tensor
    rssi: Tensor
    floor: float
    k: int
    scale_m: Tensor
    degrees: float = 4.0

    name = "fingerprints"

    def estimate(self, rssi: Tensor) -> Tensor:
        """Return the weighted mean position of the k most similar rows, (n, 3) [m]."""
        apart, row = torch.cdist(rssi.float().nan_to_num(self.floor), self.rssi).topk(self.k, largest=False)
        weight = 1 / apart.double().clamp_min(0.1)
        return (weight[..., None] * self.position[row]).sum(dim=1) / weight.sum(dim=1, keepdim=True)

    def log_likelihood(self, position: Tensor, rssi: Tensor) -> Tensor:
        """Return log-likelihoods (n, m) of candidate positions (m, 3) [m]."""
        away = (position - self.estimate(rssi)[:, None]) / self.scale_m
        return -(self.degrees + 3) / 2 * torch.log1p(away.square().sum(dim=2) / self.degrees)
