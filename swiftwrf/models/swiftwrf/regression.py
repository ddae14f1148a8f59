"""A model by regression: the spectra, not the parameters, are what is smooth in position.

Primitives that stay where they are draw a spectrum that is linear in their responses. So the responses of each training
spectrum are its least squares, and between the positions they follow from a Gaussian process as the pixels themselves would.
Only the shapes of the primitives are found step by step, by variable projection (Golub and Pereyra 1973): those that leave
least of the spectra's mean and principal components.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.spectra import Spectra
from swiftwrf.gp import EXACT, Kernel, NearbyField, SmoothField, held_out, thinned
from swiftwrf.metrics import NORMAL_80
from swiftwrf.models.swiftwrf.config import FitConfig, ModelConfig
from swiftwrf.models.swiftwrf.deformation import COMPONENTS, Deformation
from swiftwrf.models.swiftwrf.deformation.motion_basis import MotionBasis
from swiftwrf.models.swiftwrf.deformation.static import Static
from swiftwrf.models.swiftwrf.loss import spectrum_loss
from swiftwrf.models.swiftwrf.model import SwiftWRF
from swiftwrf.models.swiftwrf.primitives import Primitives
from swiftwrf.positions import frame, normalise
from swiftwrf.rasterize.reference import kernels
from swiftwrf.runtime.threads import single_thread

SHAPE_STEPS = 60
TRIAL_STEPS = 8  # tell sizes apart as well as all of them do
SHAPE_RATE = 0.02  # of means [rad] and logarithms of widths
RIDGE = 1e-6  # of a kernel's mean square: keeps neighbours from cancelling each other with large responses
MAX_ROWS = 1000  # spectra that choose the shapes and judge a size; more do not change the choice
SHAPE_AZIMUTHS = 90  # columns of the spectra that the shapes are found on: an array's beams are far wider
SINGULAR = 1e-9  # share of the variance below which a component is rounding
BEYOND = 0.5  # spacings by which the first means lie outside the grid at the horizon
FILLING = 16  # one primitive in so many starts where the others leave most
PEAK = 1.5  # its standard deviation at the start, in pixels
INSIDE = 0.8  # share of predictions inside the interval that calibrates their deviation


class Regression:
    """What models of all sizes for the same spectra share.

    Args:
        train: spectra to fit.
        config: of the fit, with a number for the rank.
        kernel: of the prior over positions, lengths in [m].
        fold: number of the part that each training spectrum is held out with, (n,).
    """

    def __init__(self, train: Spectra, config: FitConfig, kernel: Kernel, fold: Tensor) -> None:
        self.config, self.kernel = config, kernel
        (rows,) = thinned(torch.arange(len(train)), rows=MAX_ROWS)
        self.train, self.fold = train, fold[rows]
        self.some = train.subset(rows).in_memory()
        self.small = self.some.at_most(SHAPE_AZIMUTHS).in_memory()
        self.primitives: dict[tuple[int, int], Primitives] = {}

    @single_thread()
    def held_out_loss(self, n: int, steps: int = SHAPE_STEPS) -> float:
        """Of n primitives, shaped in so many steps, on spectra that the regression has not seen."""
        kernel = _kernels(self._shaped(n, steps), self.small.grid, self.config.model).detach()
        drawn, _ = self._held_out(self.small, kernel)
        return float(spectrum_loss(drawn, self.small.spectrum, self.config.ssim_weight, self.config.pixel_loss))

    @single_thread()
    def model(self, n: int) -> SwiftWRF:
        """Of n primitives, from all spectra."""
        train, primitives = self.train, self._shaped(n, SHAPE_STEPS)
        kernel = _kernels(primitives, train.grid, self.config.model).detach()
        mean, component = self._components(self.some)
        response = _responses(kernel, torch.cat([mean[None], component]))
        attenuation = torch.sigmoid(primitives.attenuation.detach())
        primitives.response.data = torch.stack([response[0] / attenuation, torch.zeros(n)], dim=1)
        config = replace(self.config.model, n_primitives=n, rank=len(component))
        centre, scale = frame(train.position)
        deformation: Deformation = Static()
        if len(component):
            flat = component.flatten(1)
            scores = [(part - mean).flatten(1) @ flat.T for part in train.store.batches()]
            score = torch.cat(scores) / flat.square().sum(dim=1)
            position = normalise(train.position, centre, scale)
            regress = SmoothField.regress if len(train) <= EXACT else NearbyField
            field = regress(position, self.kernel.scaled(1 / float(scale)), score)
            basis = torch.zeros(len(component), n, sum(COMPONENTS[c] for c in config.components))
            at = sum(COMPONENTS[c] for c in config.components[: config.components.index("response")])
            basis[..., at] = response[1:] / attenuation
            deformation = MotionBasis(field, basis, config.components, self._deviation(kernel, response[1:]))
        return SwiftWRF(config, train.grid, centre, scale, primitives, deformation)

    def _components(self, spectra: Spectra) -> tuple[Tensor, Tensor]:
        """Mean (H, W) and principal components (K, H, W) of spectra, these as large as their scores deviate."""
        mean = spectra.spectrum.mean(dim=0)
        change = (spectra.spectrum - mean).flatten(1)
        variance, vector = torch.linalg.eigh((change @ change.T).double())
        rank = min(int(self.config.model.rank), int((variance > SINGULAR * variance.sum()).sum()))
        component = vector.T[len(vector) - rank :].float() @ change / math.sqrt(len(change))
        return mean, component.reshape(rank, *mean.shape)

    def _held_out(self, spectra: Spectra, kernel: Tensor) -> tuple[Tensor, Tensor]:
        """Spectra (n, H, W) as regression without their fold draws them, and their variance relative to the prior, (n,)."""
        response = _responses(kernel, spectra.spectrum)
        mean = response.mean(dim=0)
        predicted, variance = held_out(self.kernel, spectra.position, self.fold, response - mean)
        return _draw(mean + predicted.float(), kernel).clamp(0, 1), variance.float()

    def _deviation(self, kernel: Tensor, response: Tensor) -> float:
        """By which the prior deviation of a pixel must be multiplied so that its interval holds as many held-out spectra as
        it says."""
        drawn, variance = self._held_out(self.some, kernel)
        prior = _draw(response, kernel).square().sum(dim=0).clamp_min(1e-12)
        miss = (drawn - self.some.spectrum).abs() / (variance[:, None, None] * prior).sqrt()
        return float(np.quantile(miss, INSIDE)) / NORMAL_80

    def _shaped(self, n: int, steps: int) -> Primitives:
        """n primitives that leave least of the mean spectrum and the principal components after so many steps."""
        if (n, steps) not in self.primitives:
            self.primitives[n, steps] = self._shape(replace(self.config.model, n_primitives=n), steps)
        return self.primitives[n, steps]

    @cached_property
    def _target(self) -> Tensor:
        """Mean spectrum and principal components that shapes are found on, (1 + K, H, W)."""
        mean, component = self._components(self.small)
        return torch.cat([mean[None], component])

    def _shape(self, config: ModelConfig, steps: int) -> Primitives:
        grid = self.small.grid
        primitives = config.make_primitives(grid, torch.Generator().manual_seed(self.config.seed))
        _spread(primitives)
        target, kernel = self._target, _kernels(primitives, grid, config).detach()
        _fill(primitives, (_draw(_responses(kernel, target), kernel) - target).square().sum(dim=0), grid)
        shapes = [primitives.mean, primitives.cholesky]
        optimiser = torch.optim.Adam(shapes, lr=SHAPE_RATE, betas=(0.9, 0.99))
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        for _ in range(steps):
            kernel = _kernels(primitives, grid, config)
            # at the best responses the loss does not change with them, so they count as constants
            left = _draw(_responses(kernel.detach(), target), kernel) - target
            optimiser.zero_grad()
            left.square().sum().div(target.square().sum().clamp_min(1e-12)).backward()
            optimiser.step()
            schedule.step()
        return primitives


def _spread(primitives: Primitives) -> None:
    """Means evenly over the hemisphere (Fibonacci lattice) and a little below the horizon, widths as their spacing."""
    n = len(primitives)
    spacing = math.sqrt(2 * math.pi / n)
    height = 1 - (torch.arange(n) + 0.5) / n * (1 + BEYOND * spacing)
    elevation, azimuth = torch.asin(height), torch.arange(n) * math.pi * (3 - math.sqrt(5)) % (2 * math.pi)
    wide = spacing / elevation.cos().clamp_min(spacing / (2 * math.pi))
    primitives.mean.data = torch.stack([azimuth, elevation], dim=1)
    primitives.cholesky.data = torch.stack([wide.log(), torch.zeros(n), torch.full((n,), math.log(spacing))], dim=1)


def _fill(primitives: Primitives, left: Tensor, grid: AngularGrid) -> None:
    """Moves some primitives, now narrow, to where most of the energy is left (H, W): peaks that lie between the others."""
    width = PEAK * torch.tensor([grid.azimuth_step, grid.elevation_step])
    for n in range(0, len(primitives), FILLING):
        row, column = divmod(int(left.argmax()), left.shape[1])
        mean = torch.stack([grid.azimuth[column], grid.elevation[row]]).float()
        primitives.mean.data[n] = mean
        primitives.cholesky.data[n, ::2] = width.log()
        taken = kernels(mean[None], torch.tensor([[width[0], 0.0, width[1]]]), grid, None)[0]
        left = left * (1 - taken).square()


def _kernels(primitives: Primitives, grid: AngularGrid, config: ModelConfig) -> Tensor:
    drawn = primitives()
    return kernels(drawn.mean, drawn.cholesky, grid, config.cutoff)


def _responses(kernel: Tensor, spectrum: Tensor) -> Tensor:
    """Least squares of spectra (k, H, W) on kernels (n, H, W), (k, n)."""
    flat = kernel.flatten(1).double()
    gram = flat @ flat.T
    gram += RIDGE * gram.diagonal().mean() * torch.eye(len(gram), dtype=gram.dtype)
    response: Tensor = torch.linalg.solve(gram, flat @ spectrum.flatten(1).double().T).T.float()
    return response


def _draw(response: Tensor, kernel: Tensor) -> Tensor:
    drawn: Tensor = torch.einsum("kn,nhw->khw", response, kernel)
    return drawn
