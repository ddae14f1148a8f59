"""The fit of deformable Gaussians by gradient descent."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from swiftwrf.data.spectra import Spectra
from swiftwrf.gp import Kernel, subsample
from swiftwrf.models.swiftwrf.config import FitConfig
from swiftwrf.models.swiftwrf.field import DeformableGaussians
from swiftwrf.models.swiftwrf.loss import spectrum_loss
from swiftwrf.runtime.descent import Descent, Schedule, warm_cosine
from swiftwrf.runtime.session import Record

MAX_ANCHORS = 1000  # anchors of the deformation; the time of a step grows with their square


def run_name(stage: str, n_primitives: int, steps: int = 0) -> str:
    """Return the name of one run of a fit, in its checkpoint and on the progress bar."""
    return f"{stage}, {n_primitives} primitives" + (f", {steps} steps" if steps else "")


class Optimisation(Descent[DeformableGaussians]):
    """Adam on primitives and deformation.

    Args:
        config: Options, with numbers for everything that may be "auto".
        train: Spectra to fit.
        kernel: Prior covariance of the deformation over positions, with lengths in metres.
        device: Device to compute on.
    """

    def __init__(self, config: FitConfig, train: Spectra, kernel: Kernel, device: torch.device | str) -> None:
        self.config, steps = config, config.steps
        self.coarse_steps = round(config.coarse_fraction * steps)
        generator = torch.Generator().manual_seed(config.seed)
        (anchor,) = subsample(train.position, rows=MAX_ANCHORS)
        field = DeformableGaussians.initial(config.model, train.grid, anchor, kernel, generator=generator).to(device)
        groups = [{"params": list(field.primitives.parameters()), "peak": config.rate}]
        groups += field.deformation.parameter_groups(config.rate, config.deformation_rate)
        name = run_name("final", len(field.primitives), steps)
        super().__init__(name, field, groups, Schedule(steps, config.check_every))
        self.position, self.spectrum = field.normalise(train.position.to(device)), train.spectrum.to(device)
        # everything random is sampled here, so that nothing is copied to the device between two evaluations
        batch = min(config.batch, len(train))
        self.rows = torch.randint(len(train), (steps, batch), generator=generator).to(device)
        noisy = steps if config.smoothing else 0
        self.noise = torch.randn(noisy, batch, 3, generator=generator).to(device)

    def rate(self, step: int) -> float:
        return warm_cosine(step, self.schedule.steps, self.config.warm_up, self.config.final_rate)

    def loss(self, rendered: Tensor, measured: Tensor) -> Tensor:
        """Return the loss of spectra; see `spectrum_loss`."""
        return spectrum_loss(rendered, measured, self.config.ssim_weight, self.config.pixel_loss)

    def smoothing(self) -> float:
        """Return the standard deviation of the noise on normalised positions at the present step.

        gamma 2 / cbrt(N_s) (1 - i / tau) (paper, annealed smoothing). 2 is the side of the box [-1, 1]^3, so 2 / cbrt(N_s)
        is the spacing of N_s evenly spread positions.
        """
        fine = self.step - self.coarse_steps
        annealed = max(0.0, 1 - fine / self.config.smoothing_steps)
        return self.config.smoothing * 2 / math.cbrt(len(self.position)) * annealed

    def objective(self) -> Tensor:
        config, field = self.config, self.model
        rows = self.rows[self.step]
        position = self.position[rows]
        deform = self.step >= self.coarse_steps
        if deform and (scale := self.smoothing()):
            position = position + scale * self.noise[self.step]
        rendered = field(position, deform=deform, stop_mean=config.stop_mean and deform)
        loss = self.loss(rendered, self.spectrum[rows])
        prior = field.deformation.prior()
        return loss if prior is None else loss + config.prior_weight / len(self.position) * prior

    def record(self, loss: Tensor) -> Record:
        return super().record(loss) | {"n_primitives": len(self.model.primitives)}
