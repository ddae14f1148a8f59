"""One optimisation of a model: schedule, loss, guards, state on disk."""

from __future__ import annotations

import copy
import hashlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

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
from swiftwrf.prior import thinned

AVERAGING = 0.98  # a step's weight decays by this much a step: averaged parameters predict better than the last ones
MAX_ANCHORS = 1000  # of the motion: a step costs their square
Record = dict[str, Any]


@dataclass(frozen=True)
class State:
    """Where an interrupted fit stood."""

    header: dict[str, Any]
    tensors: dict[str, Tensor]


@dataclass
class Session:
    """What the runs of one fit share: where their state is kept, and who is told.

    Args:
        path: of the state; None keeps none.
        owner: fingerprint of configuration and spectra.
        bar: shows progress.
        on_record: is told at each look.
        saved: the state of an earlier session of the same fit.
        losses: of runs that are done, on held-out spectra, by their name.
    """

    path: Path | None
    owner: str
    bar: Progress
    on_record: Callable[[Record], None] | None
    saved: State | None = None
    losses: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.path is not None and self.path.exists():
            tensors, header = files.read(self.path, "fit state")
            if header["fingerprint"] != self.owner:
                raise InputError(
                    f"{self.path} is the state of another fit (other spectra or settings); remove it or give another path"
                )
            self.saved, self.losses = State(header, tensors), header["losses"]


def fingerprint(config: FitConfig, train: Spectra) -> str:
    """Says whether a saved state belongs to this configuration and these spectra."""
    digest = hashlib.sha256(json.dumps(asdict(config)).encode())
    for tensor in (train.position, train.spectrum):
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


class Optimisation:
    """Adam on the primitives and their motion, from a seeded start; the result is the running average of the parameters.

    Args:
        config: with numbers for everything that may be `auto`.
        steps: their number.
        train: spectra to fit.
        kernel: of the motion's prior, lengths in [m].
        held_out: spectra to look at.
    """

    def __init__(
        self,
        config: FitConfig,
        steps: int,
        train: Spectra,
        kernel: Kernel,
        device: torch.device | str,
        held_out: Spectra | None = None,
    ) -> None:
        self.name = (
            f"{'final' if held_out is None else 'search'}, {config.model.n_primitives} primitives, {steps} steps"
        )
        self.steps, self.config = steps, config
        self.coarse_steps = round(config.coarse_share * steps)
        generator = torch.Generator().manual_seed(config.seed)
        (anchor,) = thinned(train.position, rows=MAX_ANCHORS)
        model = SwiftWRF(config.model, train.grid, anchor, kernel, generator=generator)
        self.model = model.to(device)
        self.position, self.spectrum = self._tensors(train)
        # everything random is drawn now: nothing is copied to the device between two looks
        batch = min(config.batch, len(train))
        self.rows = torch.randint(len(train), (steps, batch), generator=generator).to(device)
        noisy = steps if config.smoothing else 0
        self.noise = torch.randn(noisy, batch, 3, generator=generator).to(device)
        self.held_out = None if held_out is None else self._tensors(held_out)
        self.optimiser = self._optimiser()
        self.average = AveragedModel(self.model, multi_avg_fn=get_ema_multi_avg_fn(AVERAGING))
        self.step, self.seconds, self.first_loss = 0, 0.0, math.inf
        self.broken_at = torch.tensor(steps, device=device)  # the first step whose loss was not finite

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
        """Share of the peak rate: warm-up, then cosine decay."""
        cosine = 0.5 * (1 + math.cos(math.pi * step / self.steps))
        decayed = self.config.final_rate + (1 - self.config.final_rate) * cosine
        return min(1.0, (step + 1) / self.config.warm_up) * decayed

    def loss(self, drawn: Tensor, measured: Tensor) -> Tensor:
        """Paper, equation of the loss: 0.7 L1 + 0.3 (1 - SSIM) at the default weight."""
        weight, error = self.config.ssim_weight, drawn - measured
        pixels = error.abs() if self.config.pixel_loss == "l1" else error.square()
        return (1 - weight) * pixels.mean() + weight * (1 - ssim(drawn, measured).mean())

    def smoothing(self) -> float:
        """Standard deviation of the noise on normalised positions: gamma 2 / cbrt(N_s) (1 - i / tau) (paper, annealed
        smoothing); 2 is the side of the box [-1, 1]^3, so that this is the distance between N_s even positions."""
        fine = self.step - self.coarse_steps
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
        deform = self.step >= self.coarse_steps
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
    def held_out_loss(self) -> float:
        """Mean over the held-out spectra; nan where there are none."""
        if self.held_out is None:
            return math.nan
        position, measured = self.held_out
        parts = zip(position.split(64), measured.split(64), strict=True)
        deform = self.step > self.coarse_steps
        losses = [float(self.loss(self.result(p, deform=deform), m)) * len(p) for p, m in parts]
        return sum(losses) / len(position)

    def run(self, session: Session) -> Optimisation:
        """Takes all steps, from where the session's saved state stands if that is of this run; keeps the state at each
        look.

        Raises:
            FitError: it ended worse than it began.
        """
        if session.saved is not None and session.saved.header["name"] == self.name:
            self._restore(session.saved)
        task = session.bar.add_task(self.name, total=self.steps, completed=self.step)
        began = time.perf_counter() - self.seconds
        while self.step < self.steps:
            loss = self.advance()
            if self.step == 1:
                self.first_loss = float(loss)
            session.bar.update(task, completed=self.step)
            if self._looks_after(self.step):
                self.seconds = time.perf_counter() - began
                self._save(session)
                self._record(session, loss)
                if self.step == self.steps and float(loss) > self.first_loss:
                    raise FitError(
                        f"the fit ended with a loss of {float(loss):.3g}, worse than the {self.first_loss:.3g} it began "
                        f"with; {self._advice()}"
                    )
        session.bar.remove_task(task)
        return self

    def _record(self, session: Session, loss: Tensor) -> None:
        if session.on_record is not None:
            session.on_record(
                {
                    "stage": "search" if self.held_out else "final",
                    "n_primitives": self.config.model.n_primitives,
                    "steps": self.steps,
                    "step": self.step,
                    "loss": float(loss),
                    "validation": self.held_out_loss() if self.held_out else None,
                    "seconds": self.seconds,
                }
            )

    def _save(self, session: Session) -> None:
        if session.path is None:
            return
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= {f"average.{name}": value for name, value in self.average.state_dict().items()}
        for number, moments in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{number}.{name}": torch.as_tensor(value) for name, value in moments.items()}
        header = {name: getattr(self, name) for name in ("name", "step", "seconds", "first_loss")}
        header |= {"losses": session.losses, "fingerprint": session.owner}
        files.write(session.path, "fit state", tensors, header)

    def _restore(self, saved: State) -> None:
        header, tensors = saved.header, saved.tensors
        self.step, self.seconds, self.first_loss = header["step"], header["seconds"], header["first_loss"]
        for prefix, module in (("model.", self.model), ("average.", self.average)):
            module.load_state_dict({k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)})
        state = copy.deepcopy(self.optimiser.state_dict())
        for name, value in tensors.items():
            if name.startswith("optimiser."):
                _, number, moment = name.split(".")
                state["state"].setdefault(int(number), {})[moment] = value
        self.optimiser.load_state_dict(state)
