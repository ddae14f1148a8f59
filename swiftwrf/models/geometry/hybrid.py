"""Geometry with position-dependent path gains, plus a Gaussian process on the residual spectra.

    spectrum(s) = a room(s; path gains(s)) + mean + k(s, training positions) w

Path gains depend on position unless cross-validation clearly prefers constant gains. The geometric part is scaled by the
mixing weight a, fitted by least squares on held-out training spectra, so on those the sum is at least as good as either part
alone.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import each_fold, folds
from swiftwrf.data.store import Store
from swiftwrf.errors import InputError
from swiftwrf.gp import Kernel, choose_kernel, leave_folds_out
from swiftwrf.metrics import psnr
from swiftwrf.models.base import ARRAY, FIXED_END, FieldModel
from swiftwrf.models.geometry.fit import GeometryConfig, observe
from swiftwrf.models.geometry.model import GeometryModel
from swiftwrf.models.geometry.path_gains import PathGains, choose_prior, fit_path_gains, kernel_of
from swiftwrf.models.geometry.planes import advantage
from swiftwrf.models.interpolator import GPModel
from swiftwrf.runtime.threads import single_thread
from swiftwrf.runtime.validation import Fraction

MAX_SPECTRA = 10_000  # the fit inverts their covariance


class HybridModel(GPModel):
    """Geometry with position-dependent path gains, and a Gaussian process on the residual.

    An update adds to the residual. Room, path gains and mixing weight stay as fitted.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.simulated_room(n=50).split()
        >>> HybridModel(beam_width=1, max_extra_planes=0).fit(train).predict(test.position).mean.shape
        torch.Size([10, 30, 120])
    """

    name = "hybrid"
    kind = "hybrid model"
    config_type = GeometryConfig
    requires = (ARRAY, FIXED_END)
    searches = True
    batch = 256

    saved = "_room path_gains mixing_weight"
    path_gains: PathGains | None
    """gains of the paths; None if they are constant"""
    mixing_weight: Fraction
    """weight of the geometric part, 0 to 1"""
    _room: GeometryModel

    @classmethod
    def accepts_like(cls, model: FieldModel) -> bool:
        return model.room is not None

    @property
    def room(self) -> GeometryModel:
        """Room whose paths the model uses."""
        return self._room

    def _fit(self, train: Spectra, *, like: FieldModel | None = None, progress: bool = False, **_: Any) -> None:
        if len(train) > MAX_SPECTRA:
            raise InputError(
                f"hybrid inverts the covariance of its spectra, at most {MAX_SPECTRA} of them, not {len(train)}; "
                "take geometry, coarray or swiftwrf, or fewer spectra"
            )
        self._room = GeometryModel(self.config).fit(train, like=like, progress=progress)
        self._fit_residual(train, like if isinstance(like, HybridModel) else None)

    @single_thread()
    def _fit_residual(
        self, train: Spectra, like: HybridModel | None, usual_weight: float = 0.7, pixels: int = 4000
    ) -> None:
        """Choose kernel and mixing weight, and fit the process to the residuals of the paths.

        Args:
            train: Training spectra.
            like: Model whose path gains are fitted to the training spectra.
            usual_weight: Mixing weight of the residuals that choose the kernel. Not studied.
            pixels: Number of pixels, about, that choose kernel and mixing weight. Not studied.
        """
        fold = folds(train.position, self.config.validation, self.config.seed)
        predicted, measured = self._fit_path_gains(train, fold, like), train.spectrum
        stride = max(1, math.prod(train.grid.shape) // pixels) | 1
        sparse = measured.flatten(1)[:, ::stride], predicted.flatten(1)[:, ::stride]
        kernel = choose_kernel(train.position, sparse[0] - usual_weight * sparse[1], fold)
        self.mixing_weight, is_better = _mixing_weight(train.position, *sparse, fold, kernel)
        if not is_better:  # the paths alone, without a residual
            self.mixing_weight, measured = 1.0, predicted
        paths = self.mixing_weight * predicted
        self.component = self._fit_process(train.position, Store(measured - paths), fold, kernel)
        self._fit_spread(train, fold, paths)

    def _fit_path_gains(
        self, train: Spectra, fold: Tensor, like: HybridModel | None, least_advantage: float = 1.0
    ) -> Tensor:
        """Fit the path gains, and return the spectra (n, H, W) of the paths with each fold held out from the gains.

        Gains are constant if their PSNR at held-out spectra is `least_advantage` standard errors higher. Not studied.
        """
        self.path_gains = None
        if not self.room.planes or (like and not like.path_gains):
            return self.room.synthesize(train.position)
        scene, rows = observe(train, self.config)
        room = self.room
        if like and like.path_gains:
            kernel, prior, fits = like.path_gains.process.kernel, like.path_gains.prior, dict[int, PathGains]()
            self._room = room.with_order(like.room.order)
        else:
            kernel = kernel_of(scene.moving)
            self._room, prior, fits = choose_prior(room, scene, fold[rows])
        predicted = torch.empty(len(train), *train.grid.shape)
        for out, _ in each_fold(fold):  # including spectra without observed phases
            number = int(fold[out[0]])
            kept = scene.subset((fold[rows] != number).nonzero()[:, 0])
            self.path_gains = fits.get(number) or fit_path_gains(self.room, kept, kernel, prior)
            for part in out.split(self.batch):
                predicted[part] = self._paths(train.position[part])
        if not like:
            constant, measured = room.synthesize(train.position), train.spectrum
            if advantage(psnr(constant, measured), psnr(predicted, measured)) > least_advantage:
                self._room, self.path_gains = room, None
                return constant
        self.path_gains = fit_path_gains(self.room, scene, kernel, prior)
        return predicted

    def _residual(self, new: Spectra) -> Tensor:
        paths = torch.cat([self._paths(part) for part in new.position.split(self.batch)])
        return super()._residual(new) - self.mixing_weight * paths

    def _paths(self, position: Tensor) -> Tensor:
        """Return the spectra (b, H, W) that the paths predict at a batch of positions (b, 3) [m]."""
        gains = self.path_gains
        channel = self.room.channel(position) if gains is None else gains.channel(self.room, position)
        return self.room.array.spectrum(channel, self.grid)

    def _predict(self, position: Tensor, grid: AngularGrid, with_std: bool) -> tuple[Tensor, Tensor | None]:
        mean, std = super()._predict(position, grid, with_std)
        return mean + self.mixing_weight * self._paths(position) if self.mixing_weight else mean, std

    def _restored(self) -> None:
        super()._restored()
        n_paths = 1 + len(self.room.reflectors.sequence)
        if self.room.grid != self.grid or (self.path_gains is not None and self.path_gains.n_paths != n_paths):
            raise InputError(
                f"the room has {n_paths} paths on a grid of {self.room.grid.shape}, gains or components others"
            )


def _mixing_weight(
    position: Tensor, measured: Tensor, predicted: Tensor, fold: Tensor, kernel: Kernel
) -> tuple[float, bool]:
    """Return the least-squares weight, 0 to 1, of spectra of the paths (n, pixels) at spectra held out from the process.

    Also return whether the weighted paths and the process together have a smaller mean log squared error than the paths
    alone.
    """
    missed, sharp = torch.empty_like(measured), torch.empty_like(predicted)
    for out, kept, weight, _ in leave_folds_out(kernel, position, fold):
        for x, left in ((measured, missed), (predicted, sharp)):
            mean = x[kept].mean(0)
            left[out] = x[out] - mean - weight.float() @ (x[kept] - mean)
    power = float(sharp.square().sum())
    mixing = min(1.0, max(0.0, float((missed * sharp).sum()) / power)) if power > 0 else 0.0
    errors = missed - mixing * sharp, measured - predicted
    both, alone = ((x.square().mean(1) + 1e-9).log().mean() for x in errors)
    return mixing, bool(both < alone)
