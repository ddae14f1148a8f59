"""The angular neural network: ResNet-50 and a small head that points to the transmitter (paper, section 6; iArk 2020).

The paper leaves head, loss and schedule open. Here the head that trains the network gives a unit vector, so that azimuths of
359 and 1 degree are neighbours and the pole is no special place, as an offset from the mean training direction in units of
the training labels' spread, so that training starts from the constant estimator. Then kernel ridge regression takes the
head's place, from what the network sees in a spectrum and the spectrum itself: in closed form, where a short training leaves
a head half-learnt. What the network sees was fitted to the labels of its training spectra: it tells more between two of
these than between one of them and a new one, the more so the fewer they are, and counts the less for it.
"""

from __future__ import annotations

import copy
import math
import time
from dataclasses import asdict, dataclass
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch import distributed as dist
from torch.nn import functional
from torch.optim.swa_utils import update_bn

from augment import Mixed
from swiftwrf import InputError
from swiftwrf.array.angles import AngularGrid, to_angles, to_direction
from swiftwrf.data.spectra import coarsening
from swiftwrf.runtime.checkpoint import Header, expect
from swiftwrf.runtime.progress import progress
from tasks.aoa.estimators.base import ESTIMATORS, SavedEstimator, Settings
from tasks.aoa.estimators.radial import RadialRegression, coarse_pixels, kept_rows
from tasks.aoa.estimators.resnet import FEATURES, backbone, distributed
from tasks.torchrun import distribute, process_count

LEAST_ROWS = 8  # a prime number of rows can only be averaged to one, which leaves nothing to learn from
LOOKS = 30  # at each spectrum of a scene in a quick training; a training set with synthetic spectra gets several times fewer
MOST_STEPS = 1000  # of a quick training
RISING = 0.11  # share of the steps over which the learning rate rises; at one in a whole number torch would divide by 0
STATISTICS = 512  # spectra that the batch norms' statistics are taken from
LOUDEST = 1e4  # feature that is believed; others are a thousandth of that
TRUSTED = 1000  # spectra after which what the network sees in one counts half as much as the spectrum itself


@dataclass(frozen=True)
class AANNConfig:
    """How the network is trained."""

    steps: int = 125
    """optimisation steps, the same for every training set"""
    batch: int = 64
    """spectra a step, but at most half of those that train: the same ones over and over have the same statistics;
    as a step moves 25 million weights whatever its batch, one of 32 takes two thirds of the time"""
    rate: float = 2e-3
    """peak learning rate of AdamW, one cycle"""
    max_azimuths: int = 60
    """larger spectra are averaged down for the network; 0 keeps all pixels"""
    circular: bool = False
    """pad the azimuth circularly, as the physics has it, instead of with zeros"""

    @classmethod
    def quick(cls, spectra: int) -> AANNConfig:
        """As long as a scene of so many spectra needs: 125 steps leave 1,500 spectra half-learnt."""
        return cls(steps=min(max(round(LOOKS * spectra / cls.batch), cls.steps), MOST_STEPS))

    @classmethod
    def paper(cls) -> AANNConfig:
        """Full resolution and a long training."""
        return cls(steps=6000, batch=16, rate=1e-3, max_azimuths=0)


@ESTIMATORS.register("aann")
class AANN(SavedEstimator):
    """ResNet-50 with one input channel and an MLP head, from a seeded start; weights are not downloaded.

    The processes of torchrun share each batch, its statistics in the batch norms included: they train the network of one
    process but for the rounding of sums.

    Args:
        settings: seed of weights and batches, device, and the preset of the training.
        config: of the training, in place of the preset's.
    """

    kind = "angle-of-arrival network"

    def __init__(self, settings: Settings, config: AANNConfig | None = None) -> None:
        super().__init__(settings)
        config = config or (AANNConfig.paper() if settings.preset == "paper" else AANNConfig.quick(settings.spectra))
        seed, device = settings.seed, torch.device(settings.device)
        self._config, self._device = config, device
        with torch.random.fork_rng(devices=[]):  # torchvision draws its weights from the global generator
            torch.manual_seed(seed)
            network = backbone(config.circular, device.type == "cpu")
        self._network = network.to(device).to(memory_format=torch.channels_last)
        self._generator = torch.Generator().manual_seed(seed)
        self._autocast = _autocast(device)

    def _prepare(self, spectrum: Tensor) -> Tensor:
        factor = coarsening(spectrum.shape[1:], self._config.max_azimuths, LEAST_ROWS)
        small = functional.avg_pool2d(spectrum[:, None], factor)
        return (2 * small - 1).to(self._device, memory_format=torch.channels_last)

    def fit(self, train: Mixed) -> None:
        config, network = self._config, self._network
        size = min(config.batch, max(len(train) // 2, 1))
        if size < process_count():
            raise InputError(
                f"{process_count()} processes cannot share batches of {size} spectra; start at most {size}"
            )
        spectrum = torch.cat([self._prepare(part) for part in train.batches()])
        direction = to_direction(*train.label.unbind(-1)).float().to(self._device)
        self._mean = functional.normalize(direction.mean(dim=0), dim=0)
        self._spread = (direction - self._mean).square().sum(dim=1).mean().sqrt().clamp_min(1e-4)
        batches = _batches(len(train), size, config.steps, self._generator)
        given = spectrum, direction, self._mean, self._spread
        if process_count() > 1:
            away = copy.deepcopy(network).cpu()
            distribute(_train, away, config, self._device.type, batches, *(tensor.cpu() for tensor in given))
        self.history = _train(network, config, self._device.type, batches, *given)

        network.train()
        # a short training leaves the batch norms' running statistics behind the weights, so they are taken anew
        some = torch.randperm(len(train), generator=self._generator)[:STATISTICS]
        with self._autocast:
            update_bn(spectrum[some].tensor_split(math.ceil(len(some) / 64)), network)  # each part counts alike
        network.eval()
        with torch.no_grad():
            for value in network.state_dict().values():
                value.copy_(_as_kept(value))
        rows = torch.from_numpy(kept_rows(len(train), self.settings.seed))
        self._replace_head(spectrum[rows], direction[rows], 1 / (1 + TRUSTED / len(train)))

    def _replace_head(self, prepared: Tensor, direction: Tensor, trust: float) -> None:
        """From now on regression tells directions (n, 3) as it does of these; trust: in squared distances of features."""
        seen = self._seen(prepared)
        self._scale = torch.stack([_scale_of(part) for part in seen])
        self._scale[0] /= math.sqrt(trust)
        known = direction.double().cpu().numpy()
        self._direction = RadialRegression.fit(self._feature(seen), known, self.settings.seed)

    @torch.no_grad()
    def _seen(self, prepared: Tensor) -> tuple[Tensor, Tensor]:
        """What the network sees in prepared spectra, (n, 2048), and their own coarse pixels, (n, p), on the CPU."""
        without_head = nn.Sequential(*list(self._network.children())[:-1])
        with self._autocast:
            seen = torch.cat([without_head(part).flatten(1).float() for part in prepared.split(64)])
        # where all spectra are alike, batch norms have nothing to divide by and blow up rounding
        return torch.nan_to_num(seen).clamp(max=LOUDEST).cpu(), coarse_pixels(prepared[:, 0]).float().cpu()

    def _feature(self, seen: tuple[Tensor, Tensor]) -> NDArray[Any]:
        """Both, in units of their spreads or wider ones, (n, 2048 + p), with the digits that a file keeps."""
        scaled = torch.cat([part / scale for part, scale in zip(seen, self._scale, strict=True)], dim=1)
        rounded: NDArray[Any] = _as_kept(scaled).double().numpy()
        return rounded

    def estimate(self, spectrum: Tensor) -> Tensor:
        direction = torch.from_numpy(self._direction(self._feature(self._seen(self._prepare(spectrum)))))
        return torch.stack(to_angles(direction), dim=-1)

    def state(self) -> tuple[dict[str, Tensor], Header]:
        """Weights and features in half precision, to which `fit` has rounded them."""
        weights = {f"network.{name}": value for name, value in self._network.state_dict().items()}
        regression, header = self._direction.state()
        own = weights | {"known": regression.pop("known")}
        halved = {name: _as_kept(value) for name, value in own.items()}
        header |= {"config": asdict(self._config), "grid": asdict(self.settings.grid)}
        return halved | regression | {"scale": self._scale}, header

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> AANN:
        own = cls(Settings(AngularGrid(**header["grid"])), AANNConfig(**header["config"]))
        weights = own._network.state_dict()
        expect(tensors, {f"network.{name}": tuple(value.shape) for name, value in weights.items()} | {"scale": (2,)})
        own._network.load_state_dict(
            {name: tensors[f"network.{name}"].to(value.dtype) for name, value in weights.items()}
        )
        own._network.eval()
        own._scale = tensors["scale"]
        if not bool((own._scale > 0).all()):
            raise InputError(f"scales must be positive, got {own._scale.tolist()}")
        pixels = coarse_pixels(own._prepare(torch.zeros(1, *own.settings.grid.shape))[:, 0]).shape[1]
        own._direction = RadialRegression.from_state(tensors, header, FEATURES + pixels, 3)
        return own


def _batches(rows: int, size: int, steps: int, generator: torch.Generator) -> Tensor:
    """Return the row numbers of each step's batch, (steps, size): parts of one random order of the rows after the other."""
    batches, order = [], torch.empty(0, dtype=torch.int64)
    for _ in range(steps):
        if len(order) < size:
            order = torch.randperm(rows, generator=generator)
        batches.append(order[:size])
        order = order[size:]
    return torch.stack(batches)


def _train(
    network: nn.Module,
    config: AANNConfig,
    device: str,
    batches: Tensor,
    spectrum: Tensor,
    direction: Tensor,
    mean: Tensor,
    spread: Tensor,
) -> list[dict[str, Any]]:
    """Train a network in place and return its history: step, loss and seconds.

    Every process of torchrun makes this call, with its part of each batch.
    """
    number, rank = process_count(), dist.get_rank() if process_count() > 1 else 0
    network = network.to(device)
    spectrum, direction, mean, spread = (tensor.to(device) for tensor in (spectrum, direction, mean, spread))
    shared = distributed(network) if number > 1 else None
    trained = shared or network
    optimiser = torch.optim.AdamW(trained.parameters(), lr=config.rate, weight_decay=1e-2, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, config.rate, total_steps=config.steps, pct_start=RISING)
    trained.train()
    began, history = time.perf_counter(), []
    for step, batch in enumerate(progress(list(batches), "AANN", shown=rank == 0), start=1):
        rows = batch[rank::number]
        with _autocast(torch.device(device)):
            offset = trained(spectrum[rows])
        miss = (functional.normalize(mean + spread * offset.float(), dim=1) - direction[rows]) / spread
        # the mean over the processes, which DistributedDataParallel takes, becomes the mean over the batch
        loss = functional.smooth_l1_loss(miss, torch.zeros_like(miss)) * (number * len(rows) / len(batch))
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(trained.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        if step % 10 == 0 or step == config.steps:
            shown = loss.detach()
            if number > 1:
                dist.all_reduce(shown)
            history.append({"step": step, "loss": shown.item() / number, "seconds": time.perf_counter() - began})
    if shared:
        network.load_state_dict(shared.module.state_dict())
    return history


def _autocast(device: torch.device) -> torch.autocast:
    return torch.autocast(device.type, torch.bfloat16, enabled=_gains_from_bfloat16(device))


def _scale_of(rows: Tensor) -> Tensor:
    """Root mean square distance of rows (n, p) from their mean, or a thousandth of that from 0 where they are alike."""
    apart, size = ((rows - origin).square().sum(dim=1).mean().sqrt() for origin in (rows.mean(dim=0), 0))
    return torch.maximum(apart, 1e-3 * size).clamp_min(1e-6)


def _as_kept(value: Tensor) -> Tensor:
    """With the digits of a file: half of them, but for whole numbers."""
    return value.half() if value.is_floating_point() else value


def _gains_from_bfloat16(device: torch.device) -> bool:
    """GPUs do, and CPUs that multiply in it: three times faster there, slower elsewhere."""
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    return bool(torch.cpu.get_capabilities().get("avx512_bf16")) if hasattr(torch.cpu, "get_capabilities") else False
