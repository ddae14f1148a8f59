"""One optimisation of a model: schedule, loss, guards, state on disk."""

from __future__ import annotations

import copy
import hashlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, cast

import torch
from rich.progress import Progress
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from swiftwrf import checkpoint as files
from swiftwrf.data.spectra import Spectra
from swiftwrf.deformation import Kernel, MotionBasis
from swiftwrf.errors import FitError, InputError
from swiftwrf.fit_config import FitConfig
from swiftwrf.metrics import ssim
from swiftwrf.model import SwiftWRF

AVERAGING = 0.98  # a step's weight decays by this much a step: averaged parameters predict better than the last ones
Record = dict[str, Any]
Stage = Literal["search", "final"]


@dataclass(frozen=True)
class State:
    """Where an interrupted fit stood."""

    stage: Stage
    steps: int
    """steps of that stage"""
    header: dict[str, Any]
    tensors: dict[str, Tensor]


def fingerprint(config: FitConfig, train: Spectra) -> str:
    """Says whether a saved state belongs to this configuration and these spectra."""
    digest = hashlib.sha256(json.dumps(asdict(config)).encode())
    for tensor in (train.position, train.spectrum):
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


def read_state(path: Path | None, expected: str) -> State | None:
    """The state at `path`, or None where there is none yet.

    Raises:
        InputError: the state of another fit.
    """
    if path is None or not path.exists():
        return None
    tensors, header = files.read(path, "fit state")
    if header["fingerprint"] != expected:
        raise InputError(
            f"{path} is the state of another fit (other spectra or settings); remove it or give another path"
        )
    return State(header["stage"], header["steps"], header, tensors)


class Optimisation:
    """Adam on the primitives and their motion, from a seeded start; the result is the running average of the parameters.

    Args:
        stage: `search` looks at held-out spectra and stops when they are no longer predicted better; `final` runs through.
        steps: when to stop at the latest.
        train: spectra to fit.
        kernel: of the motion's prior, lengths in [m].
        held_out: spectra to look at.
    """

    def __init__(
        self,
        stage: Stage,
        steps: int,
        train: Spectra,
        kernel: Kernel,
        config: FitConfig,
        device: torch.device | str,
        held_out: Spectra | None = None,
    ) -> None:
        self.stage: Stage = stage
        self.steps, self.config = steps, config
        generator = torch.Generator().manual_seed(config.seed)
        model = SwiftWRF(config.model, train.grid, train.position, kernel, generator=generator)
        self.model = model.to(device)
        self.position, self.spectrum = self._tensors(train)
        # everything random is drawn now: nothing is copied to the device between two looks
        batch = min(config.batch, len(train))
        self.rows = torch.randint(len(train), (config.steps, batch), generator=generator).to(device)
        noisy = config.steps if config.smoothing else 0
        self.noise = torch.randn(noisy, batch, 3, generator=generator).to(device)
        self.held_out = None if held_out is None else self._tensors(held_out)
        self.optimiser = self._optimiser()
        self.average = AveragedModel(self.model, multi_avg_fn=get_ema_multi_avg_fn(AVERAGING))
        self.step, self.best_step, self.best_loss = 0, steps, math.inf
        self.broken_at = torch.tensor(steps, device=device)  # the first step whose loss was not finite
        self.seconds = 0.0

    def _tensors(self, spectra: Spectra) -> tuple[Tensor, Tensor]:
        device = self.model.centre.device
        return self.model.normalise(spectra.position.to(device)), spectra.spectrum.to(device)

    def _optimiser(self) -> torch.optim.Adam:
        rate, deformation = self.config.rate, self.model.deformation
        groups: list[dict[str, Any]] = [{"params": list(self.model.primitives.parameters()), "peak": rate}]
        if isinstance(deformation, MotionBasis):
            groups += [
                {"params": [deformation.field.coefficient], "peak": rate},
                {"params": [deformation.basis], "peak": rate / 2},
            ]
        elif deformation is not None:
            groups += [{"params": list(deformation.parameters()), "peak": self.config.deformation_rate or rate}]
        return torch.optim.Adam(groups, betas=(0.9, 0.99))

    def _rate(self, step: int) -> float:
        """Share of the peak rate: warm-up, then cosine decay over the configured steps, whatever the stage stops at."""
        cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, step / self.config.steps)))
        decayed = self.config.final_rate + (1 - self.config.final_rate) * cosine
        return min(1.0, (step + 1) / self.config.warm_up) * decayed

    def loss(self, drawn: Tensor, measured: Tensor) -> Tensor:
        """Paper, equation of the loss: 0.7 L1 + 0.3 (1 - SSIM) at the default weight."""
        weight = self.config.ssim_weight
        return (1 - weight) * (drawn - measured).abs().mean() + weight * (1 - ssim(drawn, measured).mean())

    def smoothing(self) -> float:
        """Standard deviation of the noise on normalised positions: gamma 2 / cbrt(N_s) (1 - i / tau) (paper, annealed
        smoothing); 2 is the side of the box [-1, 1]^3, so that this is the distance between N_s even positions."""
        fine = self.step - self.config.coarse_steps
        left = max(0.0, 1 - fine / self.config.smoothing_steps)
        return self.config.smoothing * 2 / math.cbrt(len(self.position)) * left

    def advance(self) -> Tensor:
        """One step; its loss.

        Raises:
            FitError: a loss or gradient that is not finite. A GPU is only asked at each look, for asking waits for it.
        """
        config, model = self.config, self.model
        rows = self.rows[self.step]
        position = self.position[rows]
        deform = self.step >= config.coarse_steps
        if deform and (scale := self.smoothing()):
            position = position + scale * self.noise[self.step]
        try:
            drawn = model(position, deform=deform, stop_mean=config.stop_mean and deform)
        except InputError as error:  # parameters ran away, so that a primitive is no longer one
            raise FitError(f"the fit broke at step {self.step}: {error}; {self._advice()}") from None
        loss = self.loss(drawn, self.spectrum[rows])
        if isinstance(model.deformation, MotionBasis):
            loss = loss + config.prior_weight / len(self.position) * model.deformation.field.prior()
        self.optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(model.parameters(), max_norm=1.0)
        finite = loss.detach().isfinite() & norm.isfinite()
        self.broken_at = torch.where(finite, self.broken_at, self.broken_at.clamp(max=self.step))
        if (not loss.is_cuda or self._looks_after(self.step + 1)) and (broken := int(self.broken_at)) <= self.step:
            raise FitError(
                f"the fit broke at step {broken}: its loss or gradient is not a finite number; {self._advice()}"
            )
        for group in self.optimiser.param_groups:
            group["lr"] = group["peak"] * self._rate(self.step)
        self.optimiser.step()
        self.average.update_parameters(self.model)
        self.step += 1
        return loss.detach()

    def _looks_after(self, step: int) -> bool:
        return step % self.config.check_every == 0 or step == self.steps

    def _advice(self) -> str:
        return f"try a learning rate below {self.config.rate:g}"

    @property
    def result(self) -> SwiftWRF:
        """The model with averaged parameters."""
        return cast(SwiftWRF, self.average.module)

    @torch.no_grad()
    def look(self) -> float | None:
        """Loss on the held-out spectra."""
        if self.held_out is None:
            return None
        position, measured = self.held_out
        parts = zip(position.split(64), measured.split(64), strict=True)
        deform = self.step > self.config.coarse_steps
        losses = [float(self.loss(self.result(p, deform=deform), m)) * len(p) for p, m in parts]
        return sum(losses) / len(position)

    def run(
        self,
        saved: State | None,
        path: Path | None,
        owner: str,
        bar: Progress,
        on_record: Callable[[Record], None] | None,
    ) -> None:
        """Goes on from `saved` where it is of this stage; keeps its state at `path` at each look."""
        if saved is not None and saved.stage == self.stage:
            self._restore(saved)
        task = bar.add_task(self.stage, total=self.steps, completed=self.step)
        every, patience = self.config.check_every, self.config.patience
        began = time.perf_counter() - self.seconds
        while self.step < self.steps and not (self.held_out and self.step - self.best_step >= patience * every):
            loss = self.advance()
            bar.update(task, completed=self.step)
            if not self._looks_after(self.step):
                continue
            held_out = self.look()
            if held_out is not None and held_out < self.best_loss:
                self.best_loss, self.best_step = held_out, self.step
            self.seconds = time.perf_counter() - began
            if path is not None:
                self._save(path, owner)
            if on_record is not None:
                on_record(
                    {
                        "stage": self.stage,
                        "step": self.step,
                        "loss": float(loss),
                        "validation": held_out,
                        "seconds": self.seconds,
                    }
                )
        bar.remove_task(task)

    def _save(self, path: Path, owner: str) -> None:
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= {f"average.{name}": value for name, value in self.average.state_dict().items()}
        for number, moments in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{number}.{name}": torch.as_tensor(value) for name, value in moments.items()}
        header = {name: getattr(self, name) for name in ("stage", "steps", "step", "best_step", "seconds")}
        header |= {"best_loss": None if math.isinf(self.best_loss) else self.best_loss, "fingerprint": owner}
        files.write(path, "fit state", tensors, header)

    def _restore(self, saved: State) -> None:
        header, tensors = saved.header, saved.tensors
        self.step, self.best_step, self.seconds = header["step"], header["best_step"], header["seconds"]
        self.best_loss = math.inf if header["best_loss"] is None else header["best_loss"]
        for prefix, module in (("model.", self.model), ("average.", self.average)):
            module.load_state_dict({k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)})
        state = copy.deepcopy(self.optimiser.state_dict())
        for name, value in tensors.items():
            if name.startswith("optimiser."):
                _, number, moment = name.split(".")
                state["state"].setdefault(int(number), {})[moment] = value
        self.optimiser.load_state_dict(state)
