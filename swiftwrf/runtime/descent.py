"""Gradient descent of long fits, whose state one file keeps so that an interrupted fit can continue."""

from __future__ import annotations

import copy
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from swiftwrf.errors import FitError, InputError
from swiftwrf.runtime import checkpoint as files
from swiftwrf.runtime.progress import progress_bar

Record = dict[str, Any]  # one evaluation of a fit
KIND = "fit state"
Model = TypeVar("Model", bound=nn.Module)

SAVED_VALUES = {"step": int, "seconds": float, "first_loss": float, "last_loss": float}  # attributes in a checkpoint


class Descent(ABC, Generic[Model]):
    """Adam with a running average of the parameters.

    Args:
        name: Name of the run on the progress bar.
        model: Module to train, on its device.
        groups: Parameter groups of Adam, each with its peak learning rate, `peak`.
        steps: Number of steps.
        check_every: Steps between two evaluations, at which a record is sent and the state is saved.
        averaging: Decay of the weight of earlier parameters at each step; 0 takes the last parameters.
        clip: Maximum norm of the gradient.
        betas, weight_decay: Options of Adam.
    """

    def __init__(
        self,
        name: str,
        model: Model,
        groups: Iterable[dict[str, Any]],
        *,
        steps: int,
        check_every: int,
        averaging: float = 0.98,  # averaged parameters predict better than the last ones
        clip: float = 1.0,
        betas: tuple[float, float] = (0.9, 0.99),
        weight_decay: float = 0.0,
    ) -> None:
        self.name, self.model, self.steps, self.check_every = name, model, steps, check_every
        self.averaging, self.clip = averaging, clip
        self.optimiser = torch.optim.Adam(groups, betas=betas, weight_decay=weight_decay)
        self.average = self.averaged()
        self.step, self.seconds = 0, 0.0
        self.first_loss = self.last_loss = math.inf
        device = next(model.parameters()).device
        self.broken_at = torch.tensor(steps, device=device)  # the first step whose loss was not finite

    def averaged(self) -> AveragedModel:
        """The running average, which begins with the parameters as they are."""
        return AveragedModel(self.model, multi_avg_fn=get_ema_multi_avg_fn(self.averaging))

    @abstractmethod
    def objective(self) -> Tensor:
        """Return the loss of the next step, a scalar."""

    @abstractmethod
    def rate(self, step: int) -> float:
        """Return the learning rates at a step as a fraction of their peaks."""

    def advance(self) -> Tensor:
        """Take one step and return its loss.

        Raises:
            FitError: The loss or gradient is not finite. On a GPU this is checked at evaluations only, because the check
                waits for the device.
        """
        try:
            loss = self.objective()
        except InputError as error:  # after a step: the parameters diverged, so that the rasterizer refuses them
            if self.step == 0:
                raise
            raise FitError(f"the fit broke at step {self.step}: {error}; {self._advice()}") from None
        self.optimiser.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), max_norm=self.clip)
        finite = loss.detach().isfinite() & norm.isfinite()
        self.broken_at = torch.where(finite, self.broken_at, self.broken_at.clamp(max=self.step))
        if (not loss.is_cuda or self._evaluates_after(self.step + 1)) and (broken := int(self.broken_at)) <= self.step:
            raise FitError(
                f"the fit broke at step {broken}: its loss or gradient is not a finite number; {self._advice()}"
            )
        fraction = self.rate(self.step)
        for group in self.optimiser.param_groups:
            group["lr"] = group["peak"] * fraction
        self.optimiser.step()
        self.average.update_parameters(self.model)
        self.step += 1
        return loss.detach()

    def _evaluates_after(self, step: int) -> bool:
        return step % self.check_every == 0 or step == self.steps

    def _advice(self) -> str:
        return f"try a learning rate below {max(group['peak'] for group in self.optimiser.param_groups):g}"

    @property
    def result(self) -> Model:
        """Model with the averaged parameters."""
        return cast(Model, self.average.module)

    def run(
        self,
        owner: str,
        *,
        checkpoint: Path | None = None,
        on_record: Callable[[Record], None] | None = None,
        progress: bool = False,
        max_growth: float = 1.1,
        **_: Any,
    ) -> Model:
        """Take all steps and return the model with averaged parameters, without gradients.

        Args:
            owner: Fingerprint of configuration and spectra.
            checkpoint: File for the state at each evaluation. If it exists, the run continues from it.
            on_record: Called at each evaluation; at first with the records of the checkpoint.
            progress: Show a progress bar on a terminal.
            max_growth: Largest ratio of the last loss to the first one in a fit that is not refused. Above 1, because steps
                have different spectra. Not studied.

        Raises:
            InputError: The checkpoint is damaged or belongs to another fit.
            FitError: The mean loss before the last evaluation is above `max_growth` times that before the first.
        """
        records: list[Record] = []
        send = on_record or (lambda record: None)
        if checkpoint is not None and checkpoint.exists():
            tensors, header = files.read(checkpoint, KIND)[1:]
            if header.get("fingerprint") != owner:
                raise InputError(
                    f"{checkpoint} is the state of another fit (other spectra or settings); remove it or give another path"
                )
            with files.refusing(f"{checkpoint} is no state that a fit can continue from"):
                records = list(header["records"])
                self._restore(tensors, header)
            for record in records:
                send(record)
        began = time.perf_counter() - self.seconds
        losses = []  # since the last evaluation; their mean depends less on the choice of spectra than one of them
        with progress_bar(progress) as bar:
            task = bar.add_task(self.name, total=self.steps, completed=self.step)
            while self.step < self.steps:
                losses.append(self.advance())
                bar.update(task, completed=self.step)
                if not self._evaluates_after(self.step):
                    continue
                loss = torch.stack(losses).mean()
                losses.clear()
                self.seconds, self.last_loss = time.perf_counter() - began, float(loss)
                if math.isinf(self.first_loss):
                    self.first_loss = self.last_loss
                records.append(self.record(loss))
                if checkpoint is not None:  # before it is sent, so that the history after an interruption has it once
                    tensors, header = self._state()
                    files.write(checkpoint, KIND, tensors, header | {"fingerprint": owner, "records": records})
                send(records[-1])
        if self.last_loss > max_growth * self.first_loss:  # also if the checkpoint is that of a completed run
            raise FitError(
                f"the fit ended with a loss of {self.last_loss:.3g}, worse than the {self.first_loss:.3g} it began with; "
                f"{self._advice()}"
            )
        return self.result.eval().requires_grad_(False)

    def record(self, loss: Tensor) -> Record:
        """Return the record of an evaluation."""
        return {
            "stage": "final",
            "steps": self.steps,
            "step": self.step,
            "loss": float(loss),
            "validation": None,
            "seconds": self.seconds,
            "elapsed": self.seconds,
        }

    def _state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= {f"average.{name}": value for name, value in self.average.state_dict().items()}
        for number, moments in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{number}.{name}": torch.as_tensor(value) for name, value in moments.items()}
        return tensors, {name: getattr(self, name) for name in SAVED_VALUES}

    def _restore(self, tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
        for name, kind in SAVED_VALUES.items():
            setattr(self, name, kind(header[name]))
        if not 0 <= self.step <= self.steps:
            raise InputError(f"its step {self.step} is not one of {self.steps}")
        for prefix, module in (("model.", self.model), ("average.", self.average)):
            module.load_state_dict({k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)})
        state: dict[str, Any] = copy.deepcopy(self.optimiser.state_dict())
        for name, value in tensors.items():
            if name.startswith("optimiser."):
                _, number, moment = name.split(".")
                state["state"].setdefault(int(number), {})[moment] = value
        self.optimiser.load_state_dict(state)


def warm_cosine(step: int, steps: int, warm_up: int, final: float) -> float:
    """Return the fraction of a rate that rises over `warm_up` steps and decays to `final` along a cosine."""
    cosine = 0.5 * (1 + math.cos(math.pi * step / steps))
    return min(1.0, (step + 1) / max(warm_up, 1)) * (final + (1 - final) * cosine)
