"""Kernel regression on the features of the angular network, its embedding of a spectrum, and on coarse pixels.

A short training leaves the head of the network under-fitted, but its features are useful. Features separate training spectra
better than unseen ones (over-fitting), so their squared distance is down-weighted by 1 / (1 + HALF_TRUST_SPECTRA / n) for n
training spectra.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Any, Self

import torch
from annotated_types import Gt
from numpy.typing import NDArray
from torch import Tensor, nn

from augment import Mixed
from augment.estimators.aann import AANN, AANNConfig, halved
from augment.estimators.base import ESTIMATORS
from augment.estimators.kernel_regression import NadarayaWatson, coarse_pixels, kept_rows
from augment.estimators.resnet import FEATURES
from swiftwrf.array.angles import to_angles
from swiftwrf.runtime.validation import PositiveInt, configuration

MAX_FEATURE = 1e4  # larger features are clipped; typical ones are a thousandth of that
HALF_TRUST_SPECTRA = 1000  # training spectra after which squared distances of features count half


@configuration
class AANNKernelConfig(AANNConfig):
    """Options of the network and its short training."""

    steps: PositiveInt = 15
    """optimisation steps, the same for every training set"""

    @classmethod
    def quick(cls, n_spectra: int, **options: Any) -> Self:
        """Return options whose steps do not grow with the scene: more do not improve the regression on held-out spectra."""
        return cls(**options)


@ESTIMATORS.register("aann_kernel")
class AANNKernel(AANN):
    """Kernel regression on the features of a briefly trained ResNet-50 and on coarse pixels.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=20, grid=swiftwrf.AngularGrid.hemisphere(10, 40))
        >>> AANNKernel(steps=1, batch=4).fit(Mixed.measured(room)).predict(room.spectrum).shape
        torch.Size([20, 2])
    """

    kind = "kernel regression on the features of an angular neural network"
    config_type = AANNKernelConfig
    saved = "_scale _direction"
    _scale: Annotated[Tensor, "float32 2", Gt(0)]
    """root mean square distances of features and of pixels from their means"""
    _direction: NadarayaWatson

    def _fit(self, train: Mixed, device: torch.device) -> None:
        prepared, direction = self._fit_network(train, device)
        rows = torch.from_numpy(kept_rows(len(train), self.config.seed))
        embedded = self._embedded(prepared[rows])
        self._scale = torch.stack([_scale_of(part) for part in embedded])
        self._scale[0] *= math.sqrt(1 + HALF_TRUST_SPECTRA / len(train))
        target = direction[rows].double().cpu().numpy()
        fitted = NadarayaWatson.fit(self._scaled(embedded), target, self.config.seed)
        self._direction = replace(fitted, known=halved(fitted.known))

    def _embedded(self, prepared: Tensor) -> tuple[Tensor, Tensor]:
        """Return the network's features (n, 2048) of prepared spectra, and their coarse pixels (n, p), on the CPU."""
        without_head = nn.Sequential(*list(self._network.children())[:-1])
        features = self._passed(without_head, prepared).clamp(max=MAX_FEATURE)
        return features, coarse_pixels(prepared[:, 0]).float().cpu()

    def _scaled(self, embedded: tuple[Tensor, Tensor]) -> NDArray[Any]:
        """Return features and pixels divided by their scales, (n, 2048 + p), with the precision of a file."""
        scaled = torch.cat([part / scale for part, scale in zip(embedded, self._scale, strict=True)], dim=1)
        rounded: NDArray[Any] = halved(scaled).double().numpy()
        return rounded

    def predict(self, spectra: Tensor) -> Tensor:
        direction = torch.from_numpy(self._direction(self._scaled(self._embedded(self._prepare(spectra)))))
        return torch.stack(to_angles(direction), dim=-1)

    def _restored(self) -> None:
        super()._restored()
        pixels = coarse_pixels(self._prepare(torch.zeros(1, *self.grid.shape))[:, 0]).shape[1]
        self._direction.check(FEATURES + pixels, 3)


def _scale_of(rows: Tensor) -> Tensor:
    """Return the root mean square distance of rows (n, p) from their mean, at least a thousandth of that from 0."""
    spread, size = ((rows - origin).square().sum(dim=1).mean().sqrt() for origin in (rows.mean(dim=0), 0))
    return torch.maximum(spread, 1e-3 * size).clamp_min(1e-6)
