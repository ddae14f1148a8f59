"""The field model of this package: 2D Gaussians, rasterized as a spectrum at any position."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import asdict, replace
from pathlib import Path

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError
from swiftwrf.gp import GaussianProcess, Kernel, SmoothField
from swiftwrf.models.base import FitContext
from swiftwrf.models.process import ProcessModel
from swiftwrf.models.swiftwrf.config import FitConfig
from swiftwrf.models.swiftwrf.deformation.low_rank import LowRankDeformation
from swiftwrf.models.swiftwrf.field import DeformableGaussians
from swiftwrf.models.swiftwrf.fit import MAX_PRIMITIVES, fit_field
from swiftwrf.rasterize.magnitude import magnitude
from swiftwrf.runtime.checkpoint import Header
from swiftwrf.runtime.session import Record

MAX_CACHED_VALUES = 2**26  # float32 values that one model caches: 256 MiB
MAX_BATCH_ON_GPU, MAX_PRIMITIVES_ON_GPU = 4096, 2**24  # positions at a time, and primitives of all of them


class SwiftWRF(ProcessModel):
    """2D Gaussians whose parameters deform with the position (M. Liu et al., 2025).

    By default a fit is a regression: the Gaussians stay in place, their responses are least squares, and a Gaussian process
    interpolates them. Such a model predicts standard deviations. `steps` above 0 fits by gradient descent instead, as the
    paper does.

    The kernels of Gaussians that stay in place are cached for each grid, so one prediction costs one matrix product.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.simulated_room(n=50).split()
        >>> model = SwiftWRF(model=swiftwrf.ModelConfig(n_primitives=16)).fit(train)
        >>> prediction = model.predict(test.position)
        >>> prediction.mean.shape == prediction.std.shape == (10, 30, 120)
        True
    """

    name = "swiftwrf"
    kind = "swiftwrf model"
    config_type = FitConfig
    searches = True
    any_grid = True

    field: DeformableGaussians
    """fitted Gaussians and their deformation; the gradients of their parameters are off after a fit"""

    def _fit(self, train: Spectra, context: FitContext) -> None:
        config: FitConfig = self.config
        if isinstance(context.like, SwiftWRF) and config.model.n_primitives == "auto":
            n = min(context.like.field.config.size[0], MAX_PRIMITIVES)
            config = replace(config, model=replace(config.model, n_primitives=n))
        self._take(fit_field(train, config, context))

    def _take(self, field: DeformableGaussians) -> None:
        self.field = field.eval().requires_grad_(False)
        self._cache: dict[tuple[object, ...], Tensor] = {}

    def parameters(self) -> Iterable[Tensor]:
        return self.field.parameters()

    @property
    def process(self) -> GaussianProcess:
        """Process of the component scores, at normalised positions.

        Raises:
            InputError: A model that was not fitted by regression, or by an earlier version.
        """
        self.check_fitted()
        deformation = self.field.deformation
        if not isinstance(deformation, LowRankDeformation) or deformation.field.value is None:
            raise InputError("only a regression can be updated, by the version that saved it; fit the model again")
        return deformation.field.process

    @process.setter
    def process(self, process: GaussianProcess) -> None:
        old = self.field.deformation
        assert isinstance(old, LowRankDeformation)
        scores = SmoothField.regress(process.known.float(), process.kernel, process.value, process)
        deformation = copy(old)
        deformation._modules = {"field": scores}
        self.field = copy(self.field)
        self.field._modules = self.field._modules | {"deformation": deformation}

    @property
    def kernel(self) -> Kernel:
        """Kernel of the component scores, lengths in [m].

        Raises:
            InputError: As `process`.
        """
        return self.process.kernel.scaled(float(self.field.scale))

    def _process_position(self, position: Tensor) -> Tensor:
        return self.field.normalise(position.to(self.device))

    def _values(self, new: Spectra) -> Tensor:
        work = new.at_most(self.config.max_azimuths)
        projection = self._cached("projection", work.grid, self.field.projection)
        return (work.store[:].to(projection) - projection[0]).flatten(1) @ projection[1:].flatten(1).T

    def _weighted_values(self) -> Tensor:
        projection = self._cached("projection", self.grid, self.field.projection)[1:]
        inverse_norm = projection.flatten(1).norm(dim=1)  # of the components, which are orthogonal
        weighted: Tensor = self.process.value / inverse_norm
        return weighted.cpu()

    def _predict(self, position: Tensor, grid: AngularGrid, with_std: bool) -> tuple[Tensor, Tensor | None]:
        field, x = self.field, self.field.normalise(position)
        gaussians = field.gaussians(x)
        few = len(field.primitives) * math.prod(grid.shape) <= MAX_CACHED_VALUES
        # a GPU renders kernels faster than it multiplies cached ones
        cacheable = few and not field.shapes_deform and x.device.type == "cpu"
        if cacheable and not any(parameter.requires_grad for parameter in self.parameters()):
            kernel = self._cached("kernel", grid, field.kernels)
            mean = _magnitudes(gaussians.weight.expand(len(x), -1, -1), kernel)
        else:
            mean = field.render(gaussians, len(x), grid)
        scale = field.deformation.unscaled_std(x) if with_std else None
        return mean, None if scale is None else scale[:, None, None] * self._cached("spread", grid, field.spread)

    def _batch_on(self, device: torch.device) -> int:
        """Return more positions on a GPU, which takes as long to start the kernels of 64 as to compute them."""
        if device.type == "cpu":
            return self.batch
        return max(self.batch, min(MAX_BATCH_ON_GPU, MAX_PRIMITIVES_ON_GPU // len(self.field.primitives)))

    def region(self) -> Tensor:
        if not isinstance(self.field.deformation, LowRankDeformation):
            return super().region()
        known = self.field.deformation.field.anchor.double() * self.field.scale + self.field.centre
        return known.cpu()

    def _cached(self, quantity: str, grid: AngularGrid, compute: Callable[[AngularGrid], Tensor]) -> Tensor:
        """Return a quantity of grid, primitives and their basis, from the cache if all are unchanged."""
        named = [*self.field.named_parameters(), *self.field.named_buffers()]
        tensors = [tensor for name, tensor in named if not name.startswith("deformation.field.")]
        if any(tensor.requires_grad for tensor in tensors):
            return compute(grid)
        state = tuple((tensor.data_ptr(), tensor._version, tensor.device) for tensor in tensors)
        key = (quantity, grid, state)
        if key not in self._cache:
            value = compute(grid)
            kept = {old: tensor for old, tensor in self._cache.items() if old[2] == state}
            while kept and sum(tensor.numel() for tensor in kept.values()) + value.numel() > MAX_CACHED_VALUES:
                del kept[next(iter(kept))]
            self._cache = kept | {key: value}
        return self._cache[key]

    def _state(self) -> tuple[dict[str, Tensor], Header]:
        field = self.field
        return field.state_dict(), {"config": asdict(field.config)} | field.deformation.header()

    def _restore(self, tensors: dict[str, Tensor], header: Header) -> None:
        self._take(DeformableGaussians.restore(self.grid, tensors, header))


def _magnitudes(weight: Tensor, kernel: Tensor) -> Tensor:
    """Return magnitudes (B, H, W) of the sum of kernels (N, H, W) with complex weights (B, N, 2)."""
    real, imaginary = weight.unbind(-1)
    field: Tensor = torch.tensordot(real, kernel, dims=1)
    if not bool(imaginary.any()):
        return field.abs()
    return magnitude(torch.stack([field, torch.tensordot(imaginary, kernel, dims=1)], dim=1))


def fit(
    train: Spectra,
    config: FitConfig | None = None,
    *,
    device: torch.device | str = "cpu",
    checkpoint: Path | None = None,
    on_record: Callable[[Record], None] | None = None,
    progress: bool = False,
) -> SwiftWRF:
    """Fit a SwiftWRF model to spectra. Equivalent to `SwiftWRF(config).fit(train, ...)`.

    Args:
        train: Training spectra, at least 10.
        config: Options of the model and its fit. Defaults to `FitConfig()`.
        device: See `FieldModel.fit`.
        checkpoint: See `FieldModel.fit`.
        on_record: See `FieldModel.fit`.
        progress: See `FieldModel.fit`.

    Raises:
        InputError: As `FieldModel.fit`.
        FitError: The loss diverged, or ended above its first value.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=50)
        >>> swiftwrf.fit(room, swiftwrf.FitConfig(model=swiftwrf.ModelConfig(n_primitives=16)))
        SwiftWRF(fitted, 30 x 120 directions)
    """
    return SwiftWRF(config).fit(train, device=device, checkpoint=checkpoint, on_record=on_record, progress=progress)
