"""The model of the paper: 2D Gaussians that a network deforms with the position, fitted by gradient descent.

    spectrum(s) = |sum_n delta_n(s) psi_n(s) kernel_n(s)|

A network evaluates offsets of mean, response psi and attenuation delta for each primitive and position. The fit is coarse to
fine: the first steps fit the primitives alone, the others the network, with the canonical means frozen.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from typing import Any

import torch
from torch import Tensor, nn

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.spectra import Spectra, fingerprint
from swiftwrf.errors import InputError
from swiftwrf.metrics import spectrum_loss
from swiftwrf.models.base import CPU, FieldConfig, FieldModel
from swiftwrf.models.mlp import SkipMLP, draw_parameters, encode
from swiftwrf.models.primitives import Primitives
from swiftwrf.positions import centre_and_half_side, normalise
from swiftwrf.rasterize import prepare, rasterize_magnitude
from swiftwrf.runtime.descent import Descent, Record, warm_cosine
from swiftwrf.runtime.validation import (
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    configuration,
)

MEAN_BANDS, POSITION_BANDS = 10, 6  # frequency bands of the paper's encodings
WIDTH, DEPTH = 156, 8  # size of the paper's network
OFFSETS = (2, 2, 1)  # numbers of offsets of mean, response and attenuation for each primitive


@configuration
class SwiftWRFPaperConfig(FieldConfig):
    """Options of `SwiftWRFPaper`. The default sizes are for a CPU; `paper` has those of the paper, for a GPU.

    Example:
        >>> SwiftWRFPaperConfig.paper(seed=1).steps
        110000
    """

    n_primitives: PositiveInt = 256
    """number N of primitives"""
    steps: PositiveInt = 4000
    """number of Adam steps, including the coarse stage"""
    coarse_fraction: Fraction = 1 / 11
    """fraction of the steps without deformation (the paper's coarse stage); later ones keep the canonical means"""
    batch: PositiveInt = 4
    """spectra per step"""
    rate: PositiveFloat = 1e-2
    """learning rate of the primitives"""
    deformation_rate: PositiveFloat = 8e-3
    """learning rate of the network"""
    ssim_weight: Fraction = 0.3
    """weight of 1 - SSIM in the loss; the absolute error of the pixels has the remaining weight"""
    smoothing: NonNegativeFloat = 1.0
    """the paper's gamma: scale of the noise on positions, annealed to 0"""
    smoothing_steps: PositiveInt = 10_000
    """the paper's tau: fine steps after which that noise is 0"""
    max_azimuths: NonNegativeInt = 180
    """fit to spectra averaged down to at most this number of columns; 0 fits to all pixels"""
    check_every: PositiveInt = 50
    """steps between two evaluations, at which a record is sent and the state is saved"""

    @classmethod
    def paper(cls, **changes: Any) -> SwiftWRFPaperConfig:
        """Return the settings of the paper: 10,000 primitives, 110,000 steps of one spectrum each, all pixels."""
        paper = cls(n_primitives=10_000, steps=110_000, batch=1, max_azimuths=0, check_every=1000)
        return replace(paper, **changes)


class SwiftWRFPaper(FieldModel):
    """2D Gaussians that a network deforms with the position (M. Liu et al., 2025), fitted by gradient descent.

    It predicts no standard deviations and cannot be updated. `SwiftWRF` fits such Gaussians in seconds. Each record of a fit
    has stage, n_primitives, steps, step, loss, seconds of the run and elapsed seconds of the fit.

    Raises:
        FitError: A loss or gradient is not finite (the checkpoint has the last good state), or the loss ends above its
            first value.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.simulated_room(n=50).split()
        >>> model = SwiftWRFPaper(n_primitives=8, steps=20).fit(train)
        >>> model.predict(test.position).mean.shape
        torch.Size([10, 30, 120])
    """

    name = "swiftwrf_paper"
    kind = "swiftwrf_paper model"
    config_type = SwiftWRFPaperConfig
    slow = True
    any_grid = True

    saved = "field"
    field: DeformableGaussians
    """fitted Gaussians and network; the gradients of their parameters are off after a fit"""

    def _fit(self, train: Spectra, *, device: torch.device = CPU, **arguments: Any) -> None:
        work = train.at_most(self.config.max_azimuths)
        owner = fingerprint(work, asdict(self.config))
        self.field = Optimisation(self.config, work, device).run(owner, **arguments)

    def parameters(self) -> Iterable[Tensor]:
        return self.field.parameters()

    def _predict(self, position: Tensor, grid: AngularGrid, with_std: bool) -> tuple[Tensor, Tensor | None]:
        return rasterize_magnitude(*self.primitives(position), grid), None

    def primitives(self, position: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return mean, cholesky and weight at positions (n, 3) [m], the arguments of `swiftwrf.rasterize`."""
        primitives: tuple[Tensor, Tensor, Tensor] = self.field(self.field.normalise(position.to(self.device)))
        return primitives

    def blank(self, saved: Mapping[str, Tensor]) -> DeformableGaussians:
        n, centre, scale = len(saved["primitives.mean"]), torch.zeros(3).double(), torch.ones(()).double()
        return DeformableGaussians(n, self.grid, centre, scale, generator=torch.Generator())

    def _restored(self) -> None:
        super()._restored()
        if not float(self.field.scale) > 0:
            raise InputError(f"scale is {float(self.field.scale)}, expected metres above 0")


class DeformableGaussians(nn.Module):
    """Canonical primitives with random parameters, and the paper's network that deforms them (section 4.2).

    The network has eight layers of width 156 on the encodings of mean and position. Every second layer takes the input
    again. The linear output starts at 0, so that the first deformed spectrum is the canonical one. A primitive and position
    costs 0.3 million multiplications: at 10,000 primitives the network, not the rasterizer, limits the spectra per second.

    Args:
        n: Number of primitives.
        grid: Directions of the training spectra.
        centre: Origin of the frame in which positions are normalised, float64 (3,) [m].
        scale: Unit of that frame, float64 () [m].
        generator: Source of randomness.
    """

    centre: Tensor
    scale: Tensor

    def __init__(self, n: int, grid: AngularGrid, centre: Tensor, scale: Tensor, *, generator: torch.Generator) -> None:
        super().__init__()
        self.register_buffer("centre", centre)
        self.register_buffer("scale", scale)
        self.primitives = Primitives(n, grid, bounded=True, generator=generator)
        self.layers = SkipMLP(2 * (2 * MEAN_BANDS + 1) + 3 * (2 * POSITION_BANDS + 1), WIDTH, DEPTH, range(2, DEPTH, 2))
        self.output = nn.Linear(WIDTH, sum(OFFSETS))
        draw_parameters(self.layers, generator)
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)

    def normalise(self, position: Tensor) -> Tensor:
        """Return positions (n, 3) [m] in the frame of the training positions, float32; differentiable.

        The bounding box of the training positions is centred in [-1, 1]^3, with one scale for all axes. The difference from
        the centre is taken in float64, so that map coordinates in kilometres keep their millimetres.
        """
        return normalise(position, self.centre, self.scale)

    def forward(self, position: Tensor, *, deform: bool = True) -> tuple[Tensor, Tensor, Tensor]:
        """Return mean (B, N, 2), Cholesky factor (N, 3) and weight (B, N, 2) of the primitives; differentiable.

        Args:
            position: Normalised positions (B, 3).
            deform: False returns the canonical primitives at all positions (the paper's coarse stage). With True the
                canonical means get no gradient.
        """
        mean, cholesky, attenuation, response = self.primitives()
        if not deform:
            weight = attenuation[:, None] * response
            return mean.expand(len(position), -1, -1), cholesky, weight.expand(len(position), -1, -1)
        mean = mean.detach()
        unit = mean / mean.new_tensor([math.pi, math.pi / 4]) - 1  # the encoding expects values in [-1, 1]
        shape = (len(position), len(mean), -1)
        of_mean, of_position = encode(unit, MEAN_BANDS), encode(position, POSITION_BANDS)[:, None]
        x = torch.cat([of_mean.expand(shape), of_position.expand(shape)], dim=-1)
        offset = self.output(self.layers(x)).split(OFFSETS, dim=-1)
        weight = (attenuation[:, None] + offset[2]) * (response + offset[1])
        return mean + offset[0], cholesky, weight


class Optimisation(Descent[DeformableGaussians]):
    """Adam on primitives and network.

    Args:
        config: Options.
        train: Spectra to fit.
        device: Device to compute on.
    """

    def __init__(self, config: SwiftWRFPaperConfig, train: Spectra, device: torch.device | str) -> None:
        if torch.device(device).type == "cpu":
            prepare("cpu")  # without numba a step would take hundreds of times as long
        self.config, self.grid, steps = config, train.grid, config.steps
        self.coarse_steps = round(config.coarse_fraction * steps)
        generator = torch.Generator().manual_seed(config.seed)
        field = DeformableGaussians(
            config.n_primitives, train.grid, *centre_and_half_side(train.position), generator=generator
        )
        network = [*field.layers.parameters(), *field.output.parameters()]
        groups = [
            {"params": list(field.to(device).primitives.parameters()), "peak": config.rate},
            {"params": network, "peak": config.deformation_rate},
        ]
        name = f"final, {config.n_primitives} primitives, {steps} steps"
        super().__init__(name, field, groups, steps=steps, check_every=config.check_every)
        self.position, self.spectrum = field.normalise(train.position.to(device)), train.spectrum.to(device)
        # everything random is sampled here, so that nothing is copied to the device between two evaluations
        batch = min(config.batch, len(train))
        self.rows = torch.randint(len(train), (steps, batch), generator=generator).to(device)
        self.noise = torch.randn(steps, batch, 3, generator=generator).to(device)

    def rate(self, step: int) -> float:
        return warm_cosine(step, self.steps, warm_up=50, final=0.02)

    def smoothing(self) -> float:
        """Return the standard deviation of the noise on normalised positions at the present step.

        gamma 2 / cbrt(N_s) (1 - i / tau) (paper, annealed smoothing). 2 is the side of the box [-1, 1]^3, so 2 / cbrt(N_s)
        is the spacing of N_s evenly spread positions.
        """
        fine = self.step - self.coarse_steps
        annealed = max(0.0, 1 - fine / self.config.smoothing_steps)
        return self.config.smoothing * 2 / math.cbrt(len(self.position)) * annealed

    def objective(self) -> Tensor:
        rows, deform = self.rows[self.step], self.step >= self.coarse_steps
        position = self.position[rows] + self.smoothing() * self.noise[self.step]
        mean, cholesky, weight = self.model(position, deform=deform)
        rendered = rasterize_magnitude(mean, cholesky, weight, self.grid)
        return spectrum_loss(rendered, self.spectrum[rows], self.config.ssim_weight)

    def record(self, loss: Tensor) -> Record:
        return super().record(loss) | {"n_primitives": self.config.n_primitives}
