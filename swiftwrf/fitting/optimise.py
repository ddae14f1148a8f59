"""One optimisation of a model: steps, rates, guards."""

from __future__ import annotations

import copy
import math
import time
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from swiftwrf.checkpoint import refusing
from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import FitError, InputError
from swiftwrf.fitting.config import FitConfig
from swiftwrf.fitting.loss import spectrum_loss
from swiftwrf.fitting.state import Record, Session, Size, State
from swiftwrf.gp import Kernel, thinned
from swiftwrf.model import SwiftWRF

AVERAGING = 0.98  # a step's weight decays by this much a step: averaged parameters predict better than the last ones
KEPT = {"step": int, "seconds": float, "first_loss": float}  # what is saved beside the tensors
MAX_ANCHORS = 1000  # of the motion: a step costs their square


class Optimisation:
    """Adam on the primitives and their motion, from a seeded start; the result is the running average of the parameters.

    Args:
        config: with numbers for everything that may be `auto`.
        train: spectra to fit.
        kernel: of the motion's prior, lengths in [m].
    """

    def __init__(self, config: FitConfig, train: Spectra, kernel: Kernel, device: torch.device | str) -> None:
        n, _ = config.model.size
        self.steps, self.config = (steps := config.steps), config
        self.size = Size(True, n, steps)
        self.coarse_steps = round(config.coarse_share * steps)
        generator = torch.Generator().manual_seed(config.seed)
        (anchor,) = thinned(train.position, rows=MAX_ANCHORS)
        model = SwiftWRF.make(config.model, train.grid, anchor, kernel, generator=generator)
        self.model = model.to(device)
        self.position, self.spectrum = self.model.normalise(train.position.to(device)), train.spectrum.to(device)
        # everything random is drawn now: nothing is copied to the device between two evaluations
        batch = min(config.batch, len(train))
        self.rows = torch.randint(len(train), (steps, batch), generator=generator).to(device)
        noisy = steps if config.smoothing else 0
        self.noise = torch.randn(noisy, batch, 3, generator=generator).to(device)
        groups = [{"params": list(self.model.primitives.parameters()), "peak": config.rate}]
        groups += self.model.deformation.parameter_groups(config.rate, config.deformation_rate)
        self.optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99))
        self.average = AveragedModel(self.model, multi_avg_fn=get_ema_multi_avg_fn(AVERAGING))
        self.step, self.seconds, self.first_loss = 0, 0.0, math.inf
        self.broken_at = torch.tensor(steps, device=device)  # the first step whose loss was not finite

    def _rate(self, step: int) -> float:
        """Share of the peak rate: warm-up, then cosine decay."""
        cosine = 0.5 * (1 + math.cos(math.pi * step / self.steps))
        decayed = self.config.final_rate + (1 - self.config.final_rate) * cosine
        return min(1.0, (step + 1) / self.config.warm_up) * decayed

    def loss(self, drawn: Tensor, measured: Tensor) -> Tensor:
        """Of spectra; see `spectrum_loss`."""
        return spectrum_loss(drawn, measured, self.config)

    def smoothing(self) -> float:
        """Standard deviation of the noise on normalised positions: gamma 2 / cbrt(N_s) (1 - i / tau) (paper, annealed
        smoothing); 2 is the side of the box [-1, 1]^3, so that this is the distance between N_s even positions."""
        fine = self.step - self.coarse_steps
        left = max(0.0, 1 - fine / self.config.smoothing_steps)
        return self.config.smoothing * 2 / math.cbrt(len(self.position)) * left

    def advance(self) -> Tensor:
        """One step; its loss.

        Raises:
            FitError: a loss or gradient that is not finite. A GPU is only asked at each evaluation, for asking waits for it.
        """
        config, model = self.config, self.model
        rows = self.rows[self.step]
        position = self.position[rows]
        deform = self.step >= self.coarse_steps
        if deform and (scale := self.smoothing()):
            position = position + scale * self.noise[self.step]
        try:
            drawn = model(position, deform=deform, stop_mean=config.stop_mean and deform)
        except InputError as error:  # parameters ran away, so that a primitive is no longer one
            raise FitError(f"the fit broke at step {self.step}: {error}; {self._advice()}") from None
        loss = self.loss(drawn, self.spectrum[rows])
        prior = model.deformation.prior()
        if prior is not None:
            loss = loss + config.prior_weight / len(self.position) * prior
        self.optimiser.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(model.parameters(), max_norm=1.0)
        finite = loss.detach().isfinite() & norm.isfinite()
        self.broken_at = torch.where(finite, self.broken_at, self.broken_at.clamp(max=self.step))
        if (not loss.is_cuda or self._evaluates_after(self.step + 1)) and (broken := int(self.broken_at)) <= self.step:
            raise FitError(
                f"the fit broke at step {broken}: its loss or gradient is not a finite number; {self._advice()}"
            )
        for group in self.optimiser.param_groups:
            group["lr"] = group["peak"] * self._rate(self.step)
        self.optimiser.step()
        self.average.update_parameters(self.model)
        self.step += 1
        return loss.detach()

    def _evaluates_after(self, step: int) -> bool:
        return step % self.config.check_every == 0 or step == self.steps

    def _advice(self) -> str:
        return f"try a learning rate below {self.config.rate:g}"

    @property
    def result(self) -> SwiftWRF:
        """The model with averaged parameters."""
        return cast(SwiftWRF, self.average.module)

    def run(self, session: Session) -> Optimisation:
        """Takes all steps, from where the session's saved state stands if that is of this run; keeps the state at each
        evaluation.

        Raises:
            FitError: it ended worse than it began.
        """
        if session.saved is not None and session.saved.header.get("run") == self.size.key:
            with refusing(f"{session.path} is no state that a fit can go on from"):
                self._restore(session.saved)
        task = session.bar.add_task(str(self.size), total=self.steps, completed=self.step)
        began = time.perf_counter() - self.seconds
        while self.step < self.steps:
            loss = self.advance()
            if self.step == 1:
                self.first_loss = float(loss)
            session.bar.update(task, completed=self.step)
            if self._evaluates_after(self.step):
                self.seconds = time.perf_counter() - began
                session.evaluated(self._record(loss), *self._state())
                if self.step == self.steps and float(loss) > self.first_loss:
                    raise FitError(
                        f"the fit ended with a loss of {float(loss):.3g}, worse than the {self.first_loss:.3g} it began "
                        f"with; {self._advice()}"
                    )
        session.bar.remove_task(task)
        return self

    def _record(self, loss: Tensor) -> Record:
        return {
            "stage": "final",
            "n_primitives": self.size.n_primitives,
            "steps": self.steps,
            "step": self.step,
            "loss": float(loss),
            "validation": None,
            "seconds": self.seconds,
        }

    def _state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= {f"average.{name}": value for name, value in self.average.state_dict().items()}
        for number, moments in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{number}.{name}": torch.as_tensor(value) for name, value in moments.items()}
        header = {name: getattr(self, name) for name in KEPT}
        return tensors, header | {"run": self.size.key}

    def _restore(self, saved: State) -> None:
        header, tensors = saved.header, saved.tensors
        self.step, self.seconds, self.first_loss = (kind(header[name]) for name, kind in KEPT.items())
        if not 0 <= self.step <= self.steps:
            raise InputError(f"its step {self.step} is none of {self.steps}")
        for prefix, module in (("model.", self.model), ("average.", self.average)):
            module.load_state_dict({k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)})
        state: dict[str, Any] = copy.deepcopy(self.optimiser.state_dict())
        for name, value in tensors.items():
            if name.startswith("optimiser."):
                _, number, moment = name.split(".")
                state["state"].setdefault(int(number), {})[moment] = value
        self.optimiser.load_state_dict(state)
