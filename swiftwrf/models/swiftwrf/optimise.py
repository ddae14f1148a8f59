"""One optimisation of a SwiftWRF model."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from swiftwrf.data.spectra import Spectra
from swiftwrf.gp import Kernel, thinned
from swiftwrf.models.swiftwrf.config import FitConfig
from swiftwrf.models.swiftwrf.loss import spectrum_loss
from swiftwrf.models.swiftwrf.model import SwiftWRF
from swiftwrf.runtime.descent import Descent, Schedule, warm_cosine
from swiftwrf.runtime.session import Record, Size

MAX_ANCHORS = 1000  # of the motion: a step costs their square


class Optimisation(Descent[SwiftWRF]):
    """Of the primitives and their motion.

    Args:
        config: with numbers for everything that may be `auto`.
        train: spectra to fit.
        kernel: of the motion's prior, lengths in [m].
    """

    def __init__(self, config: FitConfig, train: Spectra, kernel: Kernel, device: torch.device | str) -> None:
        n, _ = config.model.size
        self.size, self.config, steps = Size(True, n, config.steps), config, config.steps
        self.coarse_steps = round(config.coarse_share * steps)
        generator = torch.Generator().manual_seed(config.seed)
        (anchor,) = thinned(train.position, rows=MAX_ANCHORS)
        model = SwiftWRF.make(config.model, train.grid, anchor, kernel, generator=generator).to(device)
        groups = [{"params": list(model.primitives.parameters()), "peak": config.rate}]
        groups += model.deformation.parameter_groups(config.rate, config.deformation_rate)
        super().__init__(self.size.key, model, groups, Schedule(steps, config.check_every))
        self.position, self.spectrum = model.normalise(train.position.to(device)), train.spectrum.to(device)
        # everything random is drawn now: nothing is copied to the device between two evaluations
        batch = min(config.batch, len(train))
        self.rows = torch.randint(len(train), (steps, batch), generator=generator).to(device)
        noisy = steps if config.smoothing else 0
        self.noise = torch.randn(noisy, batch, 3, generator=generator).to(device)

    @property
    def label(self) -> str:
        return str(self.size)

    def rate(self, step: int) -> float:
        return warm_cosine(step, self.schedule.steps, self.config.warm_up, self.config.final_rate)

    def loss(self, drawn: Tensor, measured: Tensor) -> Tensor:
        """Of spectra; see `spectrum_loss`."""
        return spectrum_loss(drawn, measured, self.config.ssim_weight, self.config.pixel_loss)

    def smoothing(self) -> float:
        """Standard deviation of the noise on normalised positions: gamma 2 / cbrt(N_s) (1 - i / tau) (paper, annealed
        smoothing); 2 is the side of the box [-1, 1]^3, so that this is the distance between N_s even positions."""
        fine = self.step - self.coarse_steps
        left = max(0.0, 1 - fine / self.config.smoothing_steps)
        return self.config.smoothing * 2 / math.cbrt(len(self.position)) * left

    def objective(self) -> Tensor:
        config, model = self.config, self.model
        rows = self.rows[self.step]
        position = self.position[rows]
        deform = self.step >= self.coarse_steps
        if deform and (scale := self.smoothing()):
            position = position + scale * self.noise[self.step]
        drawn = model(position, deform=deform, stop_mean=config.stop_mean and deform)
        loss = self.loss(drawn, self.spectrum[rows])
        prior = model.deformation.prior()
        return loss if prior is None else loss + config.prior_weight / len(self.position) * prior

    def record(self, loss: Tensor) -> Record:
        return super().record(loss) | {"n_primitives": self.size.n_primitives}
