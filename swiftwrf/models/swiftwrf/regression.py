"""The fit of SwiftWRF by regression.

A spectrum of primitives with fixed shapes is linear in their responses. The responses of each training spectrum are
therefore a least-squares solution, and a Gaussian process interpolates them between positions. Only the shapes need gradient
steps, by variable projection (Golub and Pereyra 1973): they minimise the residual of the mean spectrum and the principal
components.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.spectra import Spectra
from swiftwrf.gp import Kernel, SmoothField, held_out, principal_components, subsample
from swiftwrf.metrics import std_factor
from swiftwrf.models.swiftwrf.config import FitConfig, ModelConfig
from swiftwrf.models.swiftwrf.deformation import COMPONENTS, Deformation
from swiftwrf.models.swiftwrf.deformation.low_rank import LowRankDeformation
from swiftwrf.models.swiftwrf.deformation.static import Static
from swiftwrf.models.swiftwrf.field import DeformableGaussians
from swiftwrf.models.swiftwrf.loss import spectrum_loss
from swiftwrf.models.swiftwrf.primitives import Primitives
from swiftwrf.positions import frame, normalise
from swiftwrf.rasterize.reference import kernels
from swiftwrf.runtime.threads import single_thread

SHAPE_STEPS = 60
TRIAL_STEPS = 8  # steps of a comparison of sizes; it ranks them as all steps do
SHAPE_RATE = 0.02  # learning rate of means [rad] and logarithms of widths
RIDGE = 1e-6  # regularisation relative to a kernel's mean square, against large responses of opposite sign
MAX_ROWS = 1000  # spectra that fit the shapes and compare sizes; more do not change the choice
SHAPE_AZIMUTHS = 90  # columns of the spectra that fit the shapes; the beams of an array are far wider
MIN_VARIANCE = 1e-9  # fraction of the variance below which a principal component is rounding
MARGIN = 0.5  # spacings by which the first means lie below the horizon
FILL_EVERY = 16  # one primitive in this number starts at the largest residual
PEAK_WIDTH = 1.5  # its initial standard deviation, in pixels


class Regression:
    """Regressions of any number of primitives on the same spectra.

    Args:
        train: Spectra to fit.
        config: Options, with a number for the rank.
        kernel: Prior covariance over positions, with lengths in metres.
        fold: Index of the fold of each training spectrum, (n,).
    """

    def __init__(self, train: Spectra, config: FitConfig, kernel: Kernel, fold: Tensor) -> None:
        self.config, self.kernel = config, kernel
        (rows,) = subsample(torch.arange(len(train)), rows=MAX_ROWS)
        self.train, self.fold = train, fold[rows]
        self.some = train.subset(rows).in_memory()
        self.small = self.some.at_most(SHAPE_AZIMUTHS).in_memory()
        self.primitives: dict[tuple[int, int], Primitives] = {}

    @single_thread()
    def held_out_loss(self, n: int, steps: int = SHAPE_STEPS) -> float:
        """Return the held-out loss of n primitives whose shapes had a number of steps."""
        kernel = _kernels(self._shaped(n, steps), self.small.grid, self.config.model).detach()
        predicted, _ = self._held_out(self.small, kernel)
        return float(spectrum_loss(predicted, self.small.spectrum, self.config.ssim_weight, self.config.pixel_loss))

    @single_thread()
    def field(self, n: int) -> DeformableGaussians:
        """Fit n primitives to all spectra."""
        train, primitives = self.train, self._shaped(n, SHAPE_STEPS)
        kernel = _kernels(primitives, train.grid, self.config.model).detach()
        mean, component = self._components(self.some)
        response = _responses(kernel, torch.cat([mean[None], component]))
        attenuation = torch.sigmoid(primitives.attenuation.detach())
        primitives.response.data = torch.stack([response[0] / attenuation, torch.zeros(n)], dim=1)
        config = replace(self.config.model, n_primitives=n, rank=len(component))
        centre, scale = frame(train.position)
        deformation: Deformation = Static()
        if not len(component):
            config = replace(config, deformation="none")
        else:
            flat = component.flatten(1)
            score = torch.cat([(part - mean).flatten(1) @ flat.T for part in train.store.batches()])
            score = score / flat.square().sum(dim=1)
            position = normalise(train.position, centre, scale)
            scores = SmoothField.regress(position, self.kernel.scaled(1 / float(scale)), score)
            basis = torch.zeros(len(component), n, sum(COMPONENTS[c] for c in config.components))
            at = sum(COMPONENTS[c] for c in config.components[: config.components.index("response")])
            basis[..., at] = response[1:] / attenuation
            deformation = LowRankDeformation(scores, basis, config.components, self._deviation(kernel, response[1:]))
        return DeformableGaussians(config, train.grid, centre, scale, primitives, deformation)

    def _components(self, spectra: Spectra) -> tuple[Tensor, Tensor]:
        """Return mean (H, W) and principal components (K, H, W) of spectra, scaled by their standard deviations."""
        flat = spectra.spectrum.flatten(1)
        mean, _, component = principal_components(flat, int(self.config.model.rank), MIN_VARIANCE)
        return mean.reshape(spectra.grid.shape), (component / math.sqrt(len(flat))).reshape(-1, *spectra.grid.shape)

    def _held_out(self, spectra: Spectra, kernel: Tensor) -> tuple[Tensor, Tensor]:
        """Return held-out predictions (n, H, W) of spectra, and their variances relative to the prior, (n,)."""
        response = _responses(kernel, spectra.spectrum)
        mean = response.mean(dim=0)
        predicted, variance = held_out(self.kernel, spectra.position, self.fold, response - mean)
        return _render(mean + predicted.float(), kernel).clamp(0, 1), variance.float()

    def _deviation(self, kernel: Tensor, response: Tensor) -> float:
        """Return the factor that calibrates the predictive standard deviation on held-out spectra."""
        predicted, variance = self._held_out(self.some, kernel)
        prior = _render(response, kernel).square().sum(dim=0).clamp_min(1e-12)
        miss = (predicted - self.some.spectrum).abs() / (variance[:, None, None] * prior).sqrt()
        return std_factor(miss)

    def _shaped(self, n: int, steps: int) -> Primitives:
        """Return n primitives with fitted shapes, fitted once for each number of steps."""
        if (n, steps) not in self.primitives:
            self.primitives[n, steps] = self._shape(replace(self.config.model, n_primitives=n), steps)
        return self.primitives[n, steps]

    @cached_property
    def _target(self) -> Tensor:
        """Mean spectrum and principal components that the shapes are fitted to, (1 + K, H, W)."""
        mean, component = self._components(self.small)
        return torch.cat([mean[None], component])

    def _shape(self, config: ModelConfig, steps: int) -> Primitives:
        grid = self.small.grid
        primitives = config.make_primitives(grid, torch.Generator().manual_seed(self.config.seed))
        _spread(primitives)
        target, kernel = self._target, _kernels(primitives, grid, config).detach()
        _fill(primitives, (_render(_responses(kernel, target), kernel) - target).square().sum(dim=0), grid)
        shapes = [primitives.mean, primitives.cholesky]
        optimiser = torch.optim.Adam(shapes, lr=SHAPE_RATE, betas=(0.9, 0.99))
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        for _ in range(steps):
            kernel = _kernels(primitives, grid, config)
            # the gradient by the responses is 0 at their least-squares solution, so they count as constants
            residual = _render(_responses(kernel.detach(), target), kernel) - target
            optimiser.zero_grad()
            residual.square().sum().div(target.square().sum().clamp_min(1e-12)).backward()
            optimiser.step()
            schedule.step()
        return primitives


def _spread(primitives: Primitives) -> None:
    """Place means on a Fibonacci lattice over the hemisphere and a little below the horizon, as wide as their spacing."""
    n = len(primitives)
    spacing = math.sqrt(2 * math.pi / n)
    height = 1 - (torch.arange(n) + 0.5) / n * (1 + MARGIN * spacing)
    elevation, azimuth = torch.asin(height), torch.arange(n) * math.pi * (3 - math.sqrt(5)) % (2 * math.pi)
    wide = spacing / elevation.cos().clamp_min(spacing / (2 * math.pi))
    primitives.mean.data = torch.stack([azimuth, elevation], dim=1)
    primitives.cholesky.data = torch.stack([wide.log(), torch.zeros(n), torch.full((n,), math.log(spacing))], dim=1)


def _fill(primitives: Primitives, residual: Tensor, grid: AngularGrid) -> None:
    """Move some primitives, made narrow, to the peaks of the residual energy (H, W)."""
    width = PEAK_WIDTH * torch.tensor([grid.azimuth_step, grid.elevation_step])
    for n in range(0, len(primitives), FILL_EVERY):
        row, column = divmod(int(residual.argmax()), residual.shape[1])
        mean = torch.stack([grid.azimuth[column], grid.elevation[row]]).float()
        primitives.mean.data[n] = mean
        primitives.cholesky.data[n, ::2] = width.log()
        taken = kernels(mean[None], torch.tensor([[width[0], 0.0, width[1]]]), grid, None)[0]
        residual = residual * (1 - taken).square()


def _kernels(primitives: Primitives, grid: AngularGrid, config: ModelConfig) -> Tensor:
    canonical = primitives()
    return kernels(canonical.mean, canonical.cholesky, grid, config.cutoff)


def _responses(kernel: Tensor, spectrum: Tensor) -> Tensor:
    """Return the least-squares responses (k, n) of spectra (k, H, W) on kernels (n, H, W)."""
    flat = kernel.flatten(1).double()
    gram = flat @ flat.T
    gram += RIDGE * gram.diagonal().mean() * torch.eye(len(gram), dtype=gram.dtype)
    response: Tensor = torch.linalg.solve(gram, flat @ spectrum.flatten(1).double().T).T.float()
    return response


def _render(response: Tensor, kernel: Tensor) -> Tensor:
    rendered: Tensor = torch.einsum("kn,nhw->khw", response, kernel)
    return rendered
