"""Gradient descent with guards, whose state survives interruptions: what the fits of all learnt models share."""

from __future__ import annotations

import copy
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, cast

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from swiftwrf.errors import FitError, InputError
from swiftwrf.runtime.checkpoint import refusing
from swiftwrf.runtime.session import Record, Session, State

Model = TypeVar("Model", bound=nn.Module)

KEPT = {"step": int, "seconds": float, "first_loss": float, "last_loss": float}  # what is saved beside the tensors


@dataclass(frozen=True)
class Schedule:
    """How long a descent is and how it steps.

    Args:
        steps: their number.
        check_every: steps between two evaluations, at which progress is recorded and the state kept.
        averaging: by how much a step's weight in the averaged parameters decays a step; 0 keeps the last ones.
        clip: largest norm of the gradient.
        betas, weight_decay: of Adam.
    """

    steps: int
    check_every: int
    averaging: float = 0.98  # averaged parameters predict better than the last ones
    clip: float = 1.0
    betas: tuple[float, float] = (0.9, 0.99)
    weight_decay: float = 0.0


class Descent(ABC, Generic[Model]):
    """Adam from a seeded start; the result is the running average of the parameters.

    Args:
        name: of the run within its fit.
        model: to train, on its device.
        groups: Adam's parameter groups, each with its largest learning rate, `peak`.
        schedule: how long and how.
    """

    def __init__(self, name: str, model: Model, groups: Iterable[dict[str, Any]], schedule: Schedule) -> None:
        self.name, self.model, self.schedule = name, model, schedule
        self.optimiser = torch.optim.Adam(groups, betas=schedule.betas, weight_decay=schedule.weight_decay)
        self.average = self.averaged()
        self.step, self.seconds = 0, 0.0
        self.first_loss = self.last_loss = math.inf
        device = next(model.parameters()).device
        self.broken_at = torch.tensor(schedule.steps, device=device)  # the first step whose loss was not finite

    def averaged(self) -> AveragedModel:
        """The running average, which begins with the parameters as they are."""
        return AveragedModel(self.model, multi_avg_fn=get_ema_multi_avg_fn(self.schedule.averaging))

    @property
    def label(self) -> str:
        """Its name on the progress bar."""
        return self.name

    @abstractmethod
    def objective(self) -> Tensor:
        """What the next step descends, a scalar."""

    @abstractmethod
    def rate(self, step: int) -> float:
        """Share of the largest learning rates at a step."""

    def advance(self) -> Tensor:
        """One step; its loss.

        Raises:
            FitError: a loss or gradient that is not finite. A GPU is only asked at each evaluation, for asking waits for it.
        """
        try:
            loss = self.objective()
        except InputError as error:  # parameters ran away, so that the model can no longer be drawn
            raise FitError(f"the fit broke at step {self.step}: {error}; {self._advice()}") from None
        self.optimiser.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), max_norm=self.schedule.clip)
        finite = loss.detach().isfinite() & norm.isfinite()
        self.broken_at = torch.where(finite, self.broken_at, self.broken_at.clamp(max=self.step))
        if (not loss.is_cuda or self._evaluates_after(self.step + 1)) and (broken := int(self.broken_at)) <= self.step:
            raise FitError(
                f"the fit broke at step {broken}: its loss or gradient is not a finite number; {self._advice()}"
            )
        share = self.rate(self.step)
        for group in self.optimiser.param_groups:
            group["lr"] = group["peak"] * share
        self.optimiser.step()
        self.average.update_parameters(self.model)
        self.step += 1
        return loss.detach()

    def _evaluates_after(self, step: int) -> bool:
        return step % self.schedule.check_every == 0 or step == self.schedule.steps

    def _advice(self) -> str:
        return f"try a learning rate below {max(group['peak'] for group in self.optimiser.param_groups):g}"

    @property
    def result(self) -> Model:
        """The model with averaged parameters."""
        return cast(Model, self.average.module)

    def run(self, session: Session) -> None:
        """Takes all steps, from where the session's saved state stands if that is of this run; keeps the state at each
        evaluation.

        Raises:
            FitError: it ended worse than it began.
        """
        if session.saved is not None and session.saved.header.get("run") == self.name:
            with refusing(f"{session.path} is no state that a fit can go on from"):
                self._restore(session.saved)
        steps = self.schedule.steps
        task = session.bar.add_task(self.label, total=steps, completed=self.step)
        began = time.perf_counter() - self.seconds
        while self.step < steps:
            loss = self.advance()
            if self.step == 1:
                self.first_loss = float(loss)
            session.bar.update(task, completed=self.step)
            if self._evaluates_after(self.step):
                self.seconds, self.last_loss = time.perf_counter() - began, float(loss)
                session.evaluated(self.record(loss), *self._state())
        session.bar.remove_task(task)
        if self.last_loss > self.first_loss:  # also where a kept state had ended so
            raise FitError(
                f"the fit ended with a loss of {self.last_loss:.3g}, worse than the {self.first_loss:.3g} it began with; "
                f"{self._advice()}"
            )

    def record(self, loss: Tensor) -> Record:
        """What is told at an evaluation."""
        return {
            "stage": "final",
            "steps": self.schedule.steps,
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
        return tensors, header | {"run": self.name}

    def _restore(self, saved: State) -> None:
        header, tensors = saved.header, saved.tensors
        for name, kind in KEPT.items():
            setattr(self, name, kind(header[name]))
        if not 0 <= self.step <= self.schedule.steps:
            raise InputError(f"its step {self.step} is none of {self.schedule.steps}")
        for prefix, module in (("model.", self.model), ("average.", self.average)):
            module.load_state_dict({k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)})
        state: dict[str, Any] = copy.deepcopy(self.optimiser.state_dict())
        for name, value in tensors.items():
            if name.startswith("optimiser."):
                _, number, moment = name.split(".")
                state["state"].setdefault(int(number), {})[moment] = value
        self.optimiser.load_state_dict(state)


def warm_cosine(step: int, steps: int, warm_up: int, final: float) -> float:
    """Share of a rate that rises over `warm_up` steps and decays to `final` along a cosine."""
    cosine = 0.5 * (1 + math.cos(math.pi * step / steps))
    return min(1.0, (step + 1) / max(warm_up, 1)) * (final + (1 - final) * cosine)
