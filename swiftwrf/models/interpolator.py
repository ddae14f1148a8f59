"""Field models whose dependence on position is one Gaussian process, which more spectra update in closed form.

    spectrum(s) = decode(mean + sum_k c_k(s) component_k)

The components are the principal ones of the training spectra. Their scores c_k follow one Gaussian process of the position s
with one kernel, chosen by cross-validation. Models differ in how components are decoded to directions: by their
pixels (`gp`), by 2D Gaussians (`swiftwrf`), or by the functions that the array can produce (`coarray`). The spectra of
`hybrid` are the residual ones of the paths of a room.

The standard deviation of a measurement at position s and direction d is

    std(s, d) = spread(d) sqrt(variance(s) + noise)

with the variance of the process relative to its prior. The spread follows from the errors at held-out training spectra, such
that 80 % of their pixels are inside their 80 % intervals.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Any, ClassVar, Self

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import folds, places
from swiftwrf.data.store import Store
from swiftwrf.errors import InputError
from swiftwrf.gp import GaussianProcess, Kernel, choose_kernel, leave_folds_out, principal_components, subsample
from swiftwrf.metrics import HALF_WIDTH, interval_factor
from swiftwrf.models.base import FieldModel
from swiftwrf.runtime.threads import single_thread


class Interpolator(FieldModel):
    """Base class of field models that a Gaussian process of component scores interpolates between the training positions.

    An update adds scores to the process, and components that new spectra need. Kernel, noise, mean spectrum and spread stay
    as fitted. `with_chosen_kernel` chooses kernel and noise again.
    """

    updates = True
    max_components: ClassVar[int] = 400
    """largest number of components"""
    omitted: ClassVar[float] = 1e-4
    """variance of the omitted components relative to the squared error at held-out positions"""
    grows: ClassVar[bool] = True
    """whether an update adds the components that new spectra need"""

    saved = "process component spread"
    process: GaussianProcess
    """process of the K component scores"""
    component: Annotated[Tensor, "float32 1+process.k h w"]
    """mean spectrum and its components, averaged to (h, w) pixels if they are not decoded by their pixels"""
    spread: Annotated[Tensor, "float32 grid.n_elevation grid.n_azimuth"]
    """standard deviation of a measurement far from all training positions"""

    @single_thread()
    def _fit(self, train: Spectra, **_: Any) -> None:
        fold = folds(train.position, self.config.validation, self.config.seed)
        self.component = self._fit_process(train.position, train.store, fold)
        self._fit_spread(train, fold)

    def _fit_process(self, position: Tensor, residual: Store, fold: Tensor, kernel: Kernel | None = None) -> Tensor:
        """Fit the process to spectra or their residuals (n, H, W), and return mean and components, (1 + K, H, W)."""
        kernel = kernel or choose_kernel(position, residual, fold)
        component = principal_components(position, residual, fold, kernel, self.omitted, self.max_components)
        flat = component.flatten(1)
        score = torch.cat([(part.flatten(1) - flat[0]) @ flat[1:].T for part in residual.batches()]).double()
        self.process = GaussianProcess(kernel, position, score / flat[1:].square().sum(dim=1))
        return component

    def _held_out(self, fold: Tensor, rows: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return numbers of training spectra, at most `rows`, and their predicted scores and variances without their fold.

        Shapes are (m,), (m, K) and (m,).
        """
        process, (chosen,) = self.process, subsample(torch.arange(len(fold)), rows=rows)
        parts = [
            (out, weight @ process.value[others], variance)
            for out, others, weight, variance in leave_folds_out(process.kernel, process.known, fold, chosen)
        ]
        out, score, variance = map(torch.cat, zip(*parts, strict=True))
        return out, score.float(), variance.float()

    def _fit_spread(
        self, train: Spectra, fold: Tensor, paths: Tensor | None = None, rows: int = 100, shrinkage: float = 5.0
    ) -> None:
        """Determine the spread by training spectra that are held out from the process.

        Args:
            train: Training spectra.
            fold: Number of the fold of each spectrum, (n,).
            paths: Spectra (n, H, W) of the paths, if the process is that of residuals.
            rows: Maximum number of spectra that are held out. Not studied.
            shrinkage: Weight of the mean over directions in the spread of each one, in spectra. Not studied.
        """
        out, score, variance = self._held_out(fold, rows)
        error = []
        for part in torch.arange(len(out)).split(self.batch):
            predicted = self._decode(score[part], self.grid)
            if paths is not None:
                predicted = predicted + paths[out[part]]
            error.append((predicted.clamp(0, 1) - train.store[out[part]]).abs())
        relative = torch.cat(error) / variance.sqrt()[:, None, None]
        square = relative.square()
        total = square.sum(dim=0) + shrinkage * square.mean()
        spread = (total / (len(out) + shrinkage)).sqrt().clamp_min(1e-6)
        self.spread = spread * interval_factor(relative / (HALF_WIDTH * spread), places(train.position)[out])

    @abstractmethod
    def _decode(self, score: Tensor, grid: AngularGrid) -> Tensor:
        """Return the spectra (b, H, W) of component scores (b, K) on a grid, not clipped."""

    def _predict(self, position: Tensor, grid: AngularGrid, with_std: bool) -> tuple[Tensor, Tensor | None]:
        if not with_std:
            return self._decode(self.process.mean(position).float(), grid), None
        score, variance = self.process.mean_and_variance(position)
        error = (variance + self.process.kernel.noise).sqrt().float()
        return self._decode(score.float(), grid), error[:, None, None] * self._spread_on(grid)

    def _spread_on(self, grid: AngularGrid) -> Tensor:
        """Return the spread on a grid, that of the nearest directions, (H, W)."""
        if grid == self.grid:
            return self.spread
        row = ((grid.elevation - self.grid.elevation_start) / self.grid.elevation_step).round().long()
        column = ((grid.azimuth - self.grid.azimuth_start) / self.grid.azimuth_step).round().long()
        return self.spread[row.clamp(0, self.grid.n_elevation - 1)][:, column % self.grid.n_azimuth]

    def expected_error(self, position: Tensor) -> Tensor:
        """Return the expected error at positions (n, 3) [m] relative to that far from all training positions, (n,)."""
        return (self.process.variance(position.to(self.process.known)) + self.process.kernel.noise).sqrt()

    def region(self) -> Tensor:
        return self.process.known.cpu()

    @property
    def kernel(self) -> Kernel:
        """Kernel of the process, lengths in [m]."""
        return self.process.kernel

    def with_chosen_kernel(self, without: Tensor | None = None, rows: int = 100) -> Self:
        """Return the model with the kernel and noise that predict held-out training spectra best. This model stays as it is.

        Mean spectrum and components stay as fitted.

        Args:
            without: Numbers of training spectra that are forgotten first, int64. Defaults to none.
            rows: Maximum number of held-out spectra that compare the variances of both kernels.

        Raises:
            InputError: As `forget`, or a model that cannot be updated.

        Example:
            >>> import swiftwrf, torch
            >>> data = swiftwrf.simulated_room(n=60, grid=swiftwrf.AngularGrid.hemisphere(6, 12))
            >>> model = swiftwrf.make_model("gp").fit(data.subset(torch.arange(15)))
            >>> model.update(data.subset(torch.arange(15, 60))).with_chosen_kernel().kernel.noise > 0
            True
        """
        model = self._copy() if without is None else self.forget(without)
        position, before = model.process.known.cpu(), model.process
        fold = folds(position, self.config.validation, self.config.seed)
        weighted = (
            before.value.cpu() * self.component[1:].flatten(1).norm(dim=1).cpu()
        )  # errors are those of the spectra
        model.process = before.with_kernel(choose_kernel(position, weighted, fold))
        (chosen,) = subsample(torch.arange(len(position)), rows=rows)
        old, new = (
            torch.cat([variance for *_, variance in leave_folds_out(kernel, position, fold, chosen)]).mean().sqrt()
            for kernel in (before.kernel, model.process.kernel)
        )
        model.spread = self.spread * float(old / new)  # of noisy values at held-out positions
        return model

    def _residual(self, new: Spectra) -> Tensor:
        """Return the differences of spectra from the mean spectrum at the pixels of the components, (k, h, w)."""
        factor = self.grid.n_azimuth // self.component.shape[2]
        return new.store.coarsen(factor)[:].to(self.component) - self.component[0]

    def _update(self, new: Spectra, *, ridge: float = 1e-6, least: float = 1e-3) -> None:
        """Add spectra, and components that their residuals need. Scores of these are 0 at all earlier training positions.

        Args:
            new: Spectra.
            ridge: Relative regularisation of the scores, because averaged components may depend on one another.
            least: Size of an added component, relative to the residuals, below which it is noise. Not studied.
        """
        residual, component = self._residual(new).flatten(1), self.component[1:].flatten(1)
        gram = (component @ component.T).double()
        gram.diagonal().mul_(1 + ridge)
        score = torch.linalg.solve(gram, (component @ residual.T).double()).T
        if self.grows:
            rest = residual - score.to(residual) @ component
            n = min(self.max_components - len(component), len(rest))
            _, size, direction = torch.linalg.svd(rest, full_matrices=False)
            added = direction[:n][size[:n] > least * residual.norm()]
            score = torch.cat([score, (rest @ added.T).double()], dim=1)
            self.component = torch.cat([self.component, added.unflatten(1, self.component.shape[1:])])
            self.process = self.process.widened(len(added))
        self.process = self.process.updated(new.position.to(self.process.known), score)

    def _forget(self, rows: Tensor) -> None:
        n = len(self.process.known)
        if len(rows) and not 0 <= int(rows.min()) <= int(rows.max()) < n:
            raise InputError(f"the model has training rows 0 to {n - 1}, but was asked to forget others")
        if len(rows.unique()) == n:
            raise InputError(f"the model was asked to forget all of its {n} training rows; fit another one")
        self.process = self.process.without(rows)

    def _age(self, correlation: float) -> None:
        self.process = self.process.aged(correlation)

    def _restored(self) -> None:
        super()._restored()
        pixels = self.component.shape[1:]
        factor = self.grid.n_azimuth // max(1, pixels[1]) if self.any_grid else 1
        if (pixels[0] * factor, pixels[1] * factor) != self.grid.shape:
            raise InputError(f"a grid of {self.grid.shape} pixels has components of {tuple(pixels)}")


class GPModel(Interpolator):
    """Gaussian process regression of the pixels with one kernel, chosen by cross-validation.

    A prediction among more than 2000 training spectra uses the nearest 64.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.simulated_room(n=50).split()
        >>> GPModel().fit(train).predict(test.position).mean.shape
        torch.Size([10, 30, 120])
    """

    name = "gp"
    kind = "pixel Gaussian process"

    def _decode(self, score: Tensor, grid: AngularGrid) -> Tensor:
        change: Tensor = torch.tensordot(score, self.component[1:], dims=1)
        return self.component[0] + change
