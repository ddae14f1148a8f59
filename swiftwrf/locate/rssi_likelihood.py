"""Likelihoods of RSSI by the radio maps of all receivers: values, detections, and similar fingerprints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from swiftwrf.data.dataset import Numbers
from swiftwrf.locate.student import Student
from swiftwrf.rssi import RssiModel

Maps = tuple[Tensor, Tensor]  # predicted RSSI and its standard deviation at m positions, float32 (m, R) [dBm], [dB]


def maps_at(model: RssiModel, position: Numbers) -> Maps:
    """Return the radio maps of a model at positions (m, 3) [m]."""
    prediction = model.predict(position)
    assert prediction.std is not None
    return prediction.mean.float(), prediction.std.float().clamp_min(0.5)


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

    @classmethod
    def fit(cls, mean: Tensor, detected: Tensor) -> DetectionLikelihood:
        """Fit to predicted RSSI (n, R) [dBm] and detections, bool (n, R), of held-out rows."""
        m, d = mean.double().flatten(), detected.flatten()

        def loss(raw: NDArray[np.float64]) -> float:
            chance = cls._of(raw).probability(m).clamp(1e-4, 1 - 1e-4)
            return -float(torch.where(d, chance.log(), (-chance).log1p()).mean())

        start = np.array([float(m.quantile(0.1)), 1.5, -2.0])
        return cls._of(minimize(loss, start, method="Nelder-Mead", options={"maxiter": 300}).x)

    @classmethod
    def _of(cls, raw: NDArray[np.float64]) -> DetectionLikelihood:
        return cls(float(raw[0]), float(np.exp(np.clip(raw[1], -1, 4))), float(0.9 / (1 + np.exp(-raw[2]))))

    def probability(self, mean: Tensor) -> Tensor:
        """Return the probability of a detection for each predicted RSSI [dBm], of the same shape."""
        return (1 - self.loss) * torch.sigmoid((mean - self.threshold) / self.width)

    def log_likelihood(self, mean: Tensor, rssi: Tensor) -> Tensor:
        """Return log-likelihoods (n, m) of the detections in RSSI (n, R) at candidates of predicted RSSI (m, R)."""
        chance = self.probability(mean).clamp(1e-4, 1 - 1e-4)
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

    def estimate(self, rssi: Tensor) -> Tensor:
        """Return the weighted mean position of the k most similar rows, (n, 3) [m]."""
        apart, row = torch.cdist(rssi.float().nan_to_num(self.floor), self.rssi).topk(self.k, largest=False)
        weight = 1 / apart.double().clamp_min(0.1)
        return (weight[..., None] * self.position[row]).sum(dim=1) / weight.sum(dim=1, keepdim=True)

    def log_likelihood(self, position: Tensor, rssi: Tensor) -> Tensor:
        """Return log-likelihoods (n, m) of candidate positions (m, 3) [m]."""
        away = (position - self.estimate(rssi)[:, None]) / self.scale_m
        return -(self.degrees + 3) / 2 * torch.log1p(away.square().sum(dim=2) / self.degrees)


@dataclass(frozen=True, eq=False)
class RssiLikelihoods:
    """Likelihoods of a row of RSSI that are pooled.

    Args:
        values: Distribution of the standardised errors of the radio maps, correlated between receivers (device, body,
            weather).
        detections: Likelihood of which receivers detect the transmitter.
        fingerprints: Likelihood of the position by similar training rows.
    """

    values: Student
    detections: DetectionLikelihood
    fingerprints: FingerprintLikelihood

    def __call__(self, position: Tensor, maps: Maps, rssi: Tensor) -> Tensor:
        """Return log-likelihoods, float64 (3, n, m), of RSSI (n, R) at candidates (m, 3) with radio maps (m, R)."""
        parts = (
            self.values.log_likelihood(rssi.float(), *maps),
            self.detections.log_likelihood(maps[0], rssi),
            self.fingerprints.log_likelihood(position, rssi),
        )
        return torch.stack([part.double() for part in parts])
