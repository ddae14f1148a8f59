"""The field model of this package: 2D Gaussians on the directions of the array, fitted by regression.

    spectrum(s) = |sum_n (w_0n + sum_k c_k(s) w_kn) kernel_n|

The shapes of the Gaussians do not depend on the position s, so a spectrum is linear in their weights. The weights w are
least-squares solutions for the mean spectrum and its principal components. The scores c follow a Gaussian process of the
position. Only the shapes need gradient steps, by variable projection (Golub and Pereyra 1973).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, Literal

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.spectra import Spectra
from swiftwrf.data.splits import folds
from swiftwrf.data.store import Store
from swiftwrf.gp import GaussianProcess
from swiftwrf.metrics import spectrum_loss
from swiftwrf.models.base import CPU, FieldConfig, FieldModel
from swiftwrf.models.interpolator import Interpolator
from swiftwrf.models.primitives import constrained, min_width
from swiftwrf.rasterize import rasterize_magnitude
from swiftwrf.rasterize.reference import kernels
from swiftwrf.runtime.descent import Record
from swiftwrf.runtime.progress import progress_bar
from swiftwrf.runtime.threads import single_thread
from swiftwrf.runtime.validation import NonNegativeInt, PositiveInt, configuration

CUTOFF = 1e-4  # kernel values below count as 0
MAX_CACHED_VALUES = 2**26  # float32 kernel values that one grid caches: 256 MiB


@configuration
class SwiftWRFConfig(FieldConfig):
    """Options of `SwiftWRF`.

    Example:
        >>> SwiftWRFConfig(n_primitives=64).max_azimuths
        180
    """

    n_primitives: PositiveInt | Literal["auto"] = "auto"
    """number of primitives; "auto" chooses the smallest number that predicts held-out spectra as well as more"""
    max_azimuths: NonNegativeInt = 180
    """fit to spectra averaged down to at most this number of columns; 0 fits to all pixels"""


class SwiftWRF(Interpolator):
    """2D Gaussians whose weights follow a Gaussian process of the position, fitted by regression.

    The Gaussians are those of M. Liu et al., 2025; `SwiftWRFPaper` fits them by gradient descent, as the paper does. One
    prediction costs one product with the kernels of the Gaussians, which are cached for each grid.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.simulated_room(n=50).split()
        >>> model = SwiftWRF(n_primitives=16).fit(train)
        >>> prediction = model.predict(test.position)
        >>> prediction.mean.shape == prediction.std.shape == (10, 30, 120)
        True
    """

    name = "swiftwrf"
    kind = "swiftwrf model"
    config_type = SwiftWRFConfig
    searches = True
    any_grid = True
    omitted = 5e-4  # 1e-4 takes more time without smaller errors

    saved = "mean cholesky weight"
    mean: Annotated[Tensor, "float32 n 2"]
    """azimuth and elevation of each primitive [rad]"""
    cholesky: Annotated[Tensor, "float32 n 3"]
    """Cholesky factors l1, l2, l3 of each primitive [rad]"""
    weight: Annotated[Tensor, "float32 1+process.k n"]
    """weights of the primitives in the mean spectrum, then in each component"""
    _cache: dict[AngularGrid, Tensor]

    def _fit(
        self,
        train: Spectra,
        *,
        like: FieldModel | None = None,
        device: torch.device = CPU,
        on_record: Callable[[Record], None] | None = None,
        progress: bool = False,
        **_: Any,
    ) -> None:
        n, record = self.config.n_primitives, on_record or (lambda record: None)
        if n == "auto" and isinstance(like, SwiftWRF):
            n = len(like.mean)
        with progress_bar(progress) as bar, single_thread():
            task = bar.add_task("swiftwrf", total=None)
            work = train.at_most(self.config.max_azimuths)
            small = work.at_most(90)  # the beams of an array are far wider
            fold = folds(train.position, self.config.validation, self.config.seed)
            component = self._fit_process(train.position, work.store, fold)
            self.component = Store(component).coarsen(work.grid.n_azimuth // small.grid.n_azimuth)[:]
            out, score = self._held_out(fold, rows=1000)[:2]
            measured = small.store[out]

            def loss(n: int) -> float:
                bar.update(task, description=f"swiftwrf, {n} primitives")
                shapes = _shapes(self.component, n, small.grid, 8)  # few steps rank alike
                function = kernels(*shapes, small.grid, CUTOFF)
                weight = _weights(function, self.component)
                held_out = _render(weight[0] + score @ weight[1:], function).clamp(0, 1)
                value = float(spectrum_loss(held_out, measured))
                record({"stage": "search", "n_primitives": n, "validation": value})
                return value

            if n == "auto":
                n = smallest(loss)
            self.mean, self.cholesky = _shapes(self.component, n, small.grid, 60)
            self.weight = _weights(kernels(self.mean, self.cholesky, work.grid, CUTOFF), component)
            self._cache = {}
            self._fit_spread(train, fold)
        record({"stage": "final", "n_primitives": n})
        self._move(device)

    def _move(self, device: torch.device) -> None:
        """Move the fitted tensors to a device, and start an empty cache."""
        for name in ("mean", "cholesky", "weight", "component", "spread"):
            setattr(self, name, getattr(self, name).to(device))
        if device.type != "cpu":
            known, value = self.process.known.to(device), self.process.value.to(device)
            self.process = GaussianProcess(self.process.kernel, known, value)
        self._cache = {}

    def parameters(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.mean, self.cholesky, self.weight

    def primitives(self, position: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return mean, cholesky and weight at positions (n, 3) [m], the arguments of `swiftwrf.rasterize`."""
        return self._primitives(self.process.mean(position.to(self.process.known)).float())

    def _primitives(self, score: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        real = self.weight[0] + score @ self.weight[1:]
        return self.mean.expand(len(real), -1, -1), self.cholesky, torch.stack([real, torch.zeros_like(real)], dim=-1)

    def _batch_on(self, device: torch.device) -> int:
        """Return more positions on a GPU, which takes as long to start the kernels of 64 as to compute them."""
        if device.type == "cpu":
            return self.batch
        return max(self.batch, min(4096, 2**24 // len(self.mean)))

    def _decode(self, score: Tensor, grid: AngularGrid) -> Tensor:
        mean, cholesky, weight = self._primitives(score)
        learns = any(tensor.requires_grad for tensor in self.parameters())
        # a GPU renders kernels faster than it multiplies cached ones
        if score.is_cuda or learns or len(self.mean) * math.prod(grid.shape) > MAX_CACHED_VALUES:
            return rasterize_magnitude(mean, cholesky, weight, grid, cutoff=CUTOFF)
        return _render(weight[..., 0], self._kernels_on(grid)).abs()

    @torch.inference_mode(False)  # a cached tensor must also serve calls with gradients
    @torch.no_grad()
    def _kernels_on(self, grid: AngularGrid) -> Tensor:
        """Return the kernels of the primitives on a grid, (N, H, W), those of the last two grids from the cache."""
        known = self._cache.get(grid)
        if known is None:
            known = kernels(self.mean, self.cholesky, grid, CUTOFF)
            # a new dictionary, because other threads read the old one
            self._cache = dict([*self._cache.items()][-1:]) | {grid: known}
        return known

    def _update(self, new: Spectra, **options: float) -> None:
        n = len(self.component)
        super()._update(new, **options)
        grid = new.coarsen(self.grid.n_azimuth // self.component.shape[2]).grid
        added = _weights(kernels(self.mean, self.cholesky, grid, CUTOFF), self.component[n:])
        self.weight = torch.cat([self.weight, added])

    def _restored(self) -> None:
        super()._restored()
        self._cache = {}


def fit(train: Spectra, *, device: torch.device | str = "cpu", progress: bool = False, **options: Any) -> SwiftWRF:
    """Fit a SwiftWRF model to spectra. Equivalent to `SwiftWRF(**options).fit(train)`.

    Args:
        train: Training spectra, at least 10.
        device: See `FieldModel.fit`.
        progress: See `FieldModel.fit`.
        options: Options of `SwiftWRF`, see `SwiftWRFConfig`.

    Raises:
        InputError: As `FieldModel.fit`, or an unknown option.

    Example:
        >>> import swiftwrf
        >>> swiftwrf.fit(swiftwrf.simulated_room(n=50), n_primitives=16)
        SwiftWRF(fitted, 30 x 120 directions)
    """
    return SwiftWRF(**options).fit(train, device=device, progress=progress)


def smallest(
    loss: Callable[[int], float], sizes: tuple[int, ...] = (16, 32, 64, 128, 256, 512), min_gain: float = 0.004
) -> int:
    """Return the smallest size whose loss is as low as the lowest one.

    Sizes are tried in order until one reduces the loss too little, so the search costs about as much as its last fits.

    Args:
        loss: Held-out loss of a fit of a size, of any sign.
        sizes: Sizes, ascending.
        min_gain: Relative reduction of the loss that counts. Not studied.
    """
    losses: dict[int, float] = {}
    for size in sizes:
        lowest = min(losses.values(), default=math.inf)
        losses[size] = loss(size)
        if lowest <= losses[size] + min_gain * abs(losses[size]):
            break
    lowest = min(losses.values())
    return next(size for size, value in losses.items() if value <= lowest + min_gain * abs(lowest))


def _shapes(target: Tensor, n: int, grid: AngularGrid, steps: int, margin: float = 0.5) -> tuple[Tensor, Tensor]:
    """Return means (n, 2) and Cholesky factors (n, 3) [rad] of n primitives that represent spectra (k, H, W) best.

    The means start on a Fibonacci lattice over the hemisphere and `margin` spacings below the horizon, as wide as their
    spacing. The margin was not studied.
    """
    spacing = math.sqrt(2 * math.pi / n)
    height = 1 - (torch.arange(n) + 0.5) / n * (1 + margin * spacing)
    elevation, azimuth = torch.asin(height), torch.arange(n) * math.pi * (3 - math.sqrt(5)) % (2 * math.pi)
    wide = spacing / elevation.cos().clamp_min(spacing / (2 * math.pi))
    mean = torch.stack([azimuth, elevation], dim=1)
    raw = torch.stack([wide.log(), torch.zeros(n), torch.full((n,), math.log(spacing))], dim=1)
    floor = min_width(grid)

    def residual() -> Tensor:
        function = kernels(mean, constrained(raw, floor), grid, CUTOFF)
        # the gradient by the weights is 0 at their least-squares solution, so they count as constants
        return _render(_weights(function.detach(), target), function) - target

    _fill(mean, raw, residual().square().sum(dim=0), grid)
    with torch.enable_grad():
        optimiser = torch.optim.Adam([mean.requires_grad_(), raw.requires_grad_()], lr=0.02, betas=(0.9, 0.99))
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        for _ in range(steps):
            optimiser.zero_grad()
            residual().square().sum().div(target.square().sum().clamp_min(1e-12)).backward()
            optimiser.step()
            schedule.step()
    return mean.detach(), constrained(raw.detach(), floor)


def _fill(
    mean: Tensor, raw: Tensor, residual: Tensor, grid: AngularGrid, one_in: int = 16, pixels: float = 1.5
) -> None:
    """Move one primitive in 16, 1.5 pixels wide, to each peak of the residual energy (H, W). Neither number was studied."""
    width = pixels * torch.tensor([grid.azimuth_step, grid.elevation_step])
    for n in range(0, len(mean), one_in):
        row, column = divmod(int(residual.argmax()), residual.shape[1])
        mean[n] = torch.stack([grid.azimuth[column], grid.elevation[row]]).float()
        raw[n, ::2] = width.log()
        taken = kernels(mean[n : n + 1], torch.tensor([[width[0], 0.0, width[1]]]), grid, None)[0]
        residual = residual * (1 - taken).square()


def _weights(function: Tensor, spectrum: Tensor, ridge: float = 1e-6) -> Tensor:
    """Return the least-squares weights (k, n) of spectra (k, H, W) on kernels (n, H, W).

    The regularisation, relative to the mean square of a kernel, prevents large weights of opposite sign. Not studied.
    """
    flat = function.flatten(1).double()
    gram = flat @ flat.T
    gram += ridge * gram.diagonal().mean() * torch.eye(len(gram), dtype=gram.dtype)
    weight: Tensor = torch.linalg.solve(gram, flat @ spectrum.flatten(1).double().T).T.float()
    return weight


def _render(weight: Tensor, function: Tensor) -> Tensor:
    """Return spectra (k, H, W) of weights (k, n) on kernels (n, H, W)."""
    rendered: Tensor = torch.tensordot(weight, function, dims=1)
    return rendered
