"""The angular neural network: ResNet-50 with a small head (paper, section 6; iArk 2020).

The paper leaves the perceptron that is the head, loss and schedule open. Here the head predicts a unit vector, so that
azimuths of 359 and 1 degree are neighbours and the pole needs no special case. The vector is an offset from the mean
training direction in units of the labels' spread, so that training starts from the constant estimator.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Annotated, Any, Self

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.optim.swa_utils import update_bn

from augment import Mixed
from augment.estimators.base import ESTIMATORS, Estimator, EstimatorConfig
from augment.estimators.resnet import backbone
from swiftwrf.array.angles import to_angles, to_direction
from swiftwrf.data.spectra import coarsening
from swiftwrf.runtime.checkpoint import Header, Saved
from swiftwrf.runtime.progress import progress
from swiftwrf.runtime.validation import NonNegativeInt, PositiveFloat, PositiveInt, Preset, configuration

MIN_ROWS = 8  # fewest elevations after averaging; a prime number of rows could only be averaged to one
EVALUATIONS = 30  # of each spectrum of a scene in a quick training
MAX_QUICK_STEPS = 1000
WARM_UP_FRACTION = 0.11  # of the steps with a rising learning rate; if one in a whole number, torch would divide by 0
MAX_NORM_SPECTRA = 512  # spectra for the final statistics of the batch norms
BATCH_SPECTRA = 64  # spectra that pass through the trained network at a time


@configuration
class AANNConfig(EstimatorConfig):
    """Options of the network and its training."""

    steps: PositiveInt = 125
    """optimisation steps, the same for every training set"""
    batch: PositiveInt = 64
    """spectra a step, at most half of the training set, so that the batch statistics vary; a step updates 25 million weights
    whatever its batch, so one of 32 takes two thirds of the time"""
    rate: PositiveFloat = 2e-3
    """peak learning rate of AdamW, one cycle"""
    max_azimuths: NonNegativeInt = 60
    """larger spectra are averaged down for the network; 0 keeps all pixels"""

    @classmethod
    def for_scene(cls, n_spectra: int, preset: Preset, **options: Any) -> Self:
        return cls.paper(**options) if preset == "paper" else cls.quick(n_spectra, **options)

    @classmethod
    def quick(cls, n_spectra: int, **options: Any) -> Self:
        """Return options whose steps grow with the scene: few steps under-fit 1,500 spectra."""
        steps = round(EVALUATIONS * n_spectra / cls.batch)
        return cls(**{"steps": min(max(steps, cls.steps), MAX_QUICK_STEPS)} | options)

    @classmethod
    def paper(cls, **options: Any) -> Self:
        """Return options for all pixels and a long training."""
        return cls(steps=6000, batch=16, rate=1e-3, max_azimuths=0, **options)


@ESTIMATORS.register("aann")
class AANN(Estimator, Saved):
    """ResNet-50 and a multilayer perceptron, the network of the paper, from a seeded start without downloads.

    Example:
        >>> import swiftwrf
        >>> room = swiftwrf.simulated_room(n=20, grid=swiftwrf.AngularGrid.hemisphere(10, 40))
        >>> AANN(steps=1, batch=4).fit(Mixed.measured(room)).predict(room.spectrum).shape
        torch.Size([20, 2])
    """

    kind = "angular neural network"
    config_type = AANNConfig
    saved = "_network _offset"
    _network: nn.Module
    _offset: Annotated[Tensor, "float32 4"]
    """mean training direction and spread of the labels"""

    def _build(self, device: torch.device) -> None:
        with torch.random.fork_rng(devices=[]):  # torchvision uses the global generator
            torch.manual_seed(self.config.seed)
            network = backbone(device.type == "cpu")
        self._network = network.to(device).to(memory_format=torch.channels_last)
        self._device = device

    def to(self, device: torch.device | str) -> Self:
        """Move the network to a device and return the estimator."""
        self._device = torch.device(device)
        self._network.to(self._device)
        return self

    def _prepare(self, spectra: Tensor) -> Tensor:
        factor = coarsening(spectra.shape[1:], self.config.max_azimuths, MIN_ROWS)
        small = functional.avg_pool2d(spectra[:, None], factor)
        return (2 * small - 1).to(self._device, memory_format=torch.channels_last)

    def _fit(self, train: Mixed, device: torch.device) -> None:
        self._fit_network(train, device)

    def _fit_network(self, train: Mixed, device: torch.device) -> tuple[Tensor, Tensor]:
        """Train the network. Return the prepared spectra and their unit vectors (n, 3)."""
        self._build(device)
        config, network = self.config, self._network
        generator = torch.Generator().manual_seed(config.seed)
        size = min(config.batch, max(len(train) // 2, 1))
        prepared = torch.cat([self._prepare(part) for part in train.batches()])
        direction = to_direction(*train.label.unbind(-1)).float().to(device)
        mean = functional.normalize(direction.mean(dim=0), dim=0)
        spread = (direction - mean).square().sum(dim=1).mean().sqrt().clamp_min(1e-4)
        batches = _batches(len(train), size, config.steps, generator)
        self._offset = torch.cat([mean, spread[None]]).cpu()
        self.history = self._train(batches, prepared, direction, mean, spread)

        network.train()
        # a short training leaves the batch norms' running statistics behind the weights, so they are computed again
        some = torch.randperm(len(train), generator=generator)[:MAX_NORM_SPECTRA]
        with _autocast(device):
            update_bn(
                prepared[some].tensor_split(math.ceil(len(some) / BATCH_SPECTRA)), network
            )  # parts of equal weight
        network.eval()
        with torch.no_grad():
            for value in network.state_dict().values():
                value.copy_(halved(value))
        return prepared, direction

    def _train(
        self, batches: Tensor, spectrum: Tensor, direction: Tensor, mean: Tensor, spread: Tensor
    ) -> list[dict[str, Any]]:
        """Train the network and return its history: step, loss and seconds."""
        config, network = self.config, self._network
        optimiser = torch.optim.AdamW(network.parameters(), lr=config.rate, weight_decay=1e-2, fused=True)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimiser, config.rate, total_steps=config.steps, pct_start=WARM_UP_FRACTION
        )
        network.train()
        began, history = time.perf_counter(), []
        for step, rows in enumerate(progress(list(batches), "AANN"), start=1):
            with _autocast(self._device):
                offset = network(spectrum[rows])
            miss = (functional.normalize(mean + spread * offset.float(), dim=1) - direction[rows]) / spread
            loss = functional.smooth_l1_loss(miss, torch.zeros_like(miss))
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            schedule.step()
            if step % 10 == 0 or step == config.steps:
                history.append({"step": step, "loss": loss.item(), "seconds": time.perf_counter() - began})
        return history

    @torch.no_grad()
    def predict(self, spectra: Tensor) -> Tensor:
        mean, spread = self._offset[:3], self._offset[3]
        direction = functional.normalize(mean + spread * self._passed(self._network, self._prepare(spectra)), dim=1)
        return torch.stack(to_angles(direction.double()), dim=-1)

    @torch.no_grad()
    def _passed(self, network: nn.Module, prepared: Tensor) -> Tensor:
        """Return the outputs (n, k) of the network, or of a part of it, on the CPU."""
        with _autocast(self._device):
            outputs = [network(part).flatten(1).float().cpu() for part in prepared.split(BATCH_SPECTRA)]
        # if all spectra are equal, batch norms amplify rounding errors
        return torch.nan_to_num(torch.cat(outputs), posinf=0, neginf=0)

    def state(self) -> tuple[dict[str, Tensor], Header]:
        tensors, header = super().state()
        return {name: halved(x) if name.startswith("_network.") else x for name, x in tensors.items()}, header

    def blank(self, saved: Mapping[str, Tensor]) -> nn.Module:
        return backbone(products=True)

    def _restored(self) -> None:
        self._device = torch.device("cpu")
        self._network.to(memory_format=torch.channels_last)


def _batches(rows: int, size: int, steps: int, generator: torch.Generator) -> Tensor:
    """Return the row numbers of each step's batch, (steps, size): consecutive parts of random orders of the rows."""
    batches, order = [], torch.empty(0, dtype=torch.int64)
    for _ in range(steps):
        if len(order) < size:
            order = torch.randperm(rows, generator=generator)
        batches.append(order[:size])
        order = order[size:]
    return torch.stack(batches)


def _autocast(device: torch.device) -> torch.autocast:
    return torch.autocast(device.type, torch.bfloat16, enabled=_gains_from_bfloat16(device))


def halved(value: Tensor) -> Tensor:
    """Return floating-point values in half precision, the precision of a file."""
    return value.half() if value.is_floating_point() else value


def _gains_from_bfloat16(device: torch.device) -> bool:
    """Return True for devices that multiply in bfloat16: a third of the time there, slower elsewhere."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    allowed = torch.backends.cpu.get_cpu_capability().startswith("AVX512")  # ATEN_CPU_CAPABILITY may exclude it
    has_list = hasattr(torch.cpu, "get_capabilities")
    return allowed and has_list and bool(torch.cpu.get_capabilities().get("avx512_bf16"))
