"""RSSI from SwiftWRF: for each receiver a small spectrum that moves with the transmitter, averaged to one number.

    rssi_r(s) = T_r - 10 gamma_r log10 |s - receiver_r| + directivity_r(s) + 100 (pooled_r(s) - pooled_r)       [dBm]

pooled_r(s) is the magnitude of receiver r's primitives on a 16 x 16 grid, averaged over the grid; pooled_r that of the
canonical ones; 100 dB a unit is the scale of the NeRF2 data (rssi = 100 (a - 1)). The directivity is a few harmonics of the
direction from the receiver. Only the responses move, by smooth functions of position, so the field at any position is a
sum of a few fields, the same for all positions. All receivers of a group are one batched program.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.angles import AngularGrid
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import MIN_TRAINING, folds
from swiftwrf.errors import FitError, InputError
from swiftwrf.fitting.config import RssiConfig
from swiftwrf.gp import Kernel, SmoothField, candidates, held_out_weights, thinned
from swiftwrf.model.primitives import Primitives
from swiftwrf.positions import check_positions
from swiftwrf.progress import progress
from swiftwrf.rasterize import rasterize
from swiftwrf.rasterize.magnitude import magnitude

GRID = AngularGrid.hemisphere(16, 16)
SCALE = 100.0  # dB per unit of pooled magnitude
NEAREST = 0.3  # [m] distances below it count as it: the log-distance law ends somewhere
MAX_ANCHORS = 1500
UNCERTAINTY_ANCHORS = 400  # are enough to tell measured regions from others, at a tenth of the cost
GROUP = 16  # receivers fitted as one program: bounds the memory of hundreds
DIRECTIVITY_DB = 2.0  # prior deviation of each harmonic of a receiver's antenna and surroundings
HARMONICS = 8  # real spherical harmonics of degree 1 and 2
JITTER = 1e-3  # of the field's prior where anchors nearly coincide
NOISES = (0.3, 1.0, 2.0, 3.0)  # variance of a packet relative to that of the field: fading is as large as shadowing
Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]


def log_distance(position: Tensor, receiver: Tensor) -> Tensor:
    """log10 of the distances [m] from positions (B, 3) to receivers (R, 3), float64 (B, R)."""
    return torch.cdist(position.double(), receiver).clamp_min(NEAREST).log10()


class ReceiverGroup(nn.Module):
    """Some receivers, fitted as one batched program.

    Args:
        receiver: positions (R, 3) [m].
        anchor: positions (M, 3) [m] of training rows.
        kernel: of the field's prior, lengths in [m]; its noise is that of the packets, relative to the field.
        n_primitives: a receiver; 0 leaves the log-distance law.
        config: rank, and what is learnt.
    """

    def __init__(self, receiver: Tensor, anchor: Tensor, kernel: Kernel, n_primitives: int, config: RssiConfig) -> None:
        super().__init__()
        n, rank = len(receiver), config.rank
        generator = torch.Generator().manual_seed(config.seed)
        self.rank, self.kernel, self.on_law = rank, kernel, config.law
        self.register_buffer("receiver", receiver.double())
        self.register_buffer("centre", anchor.double().mean(dim=0))
        self.register_buffer("field_db", torch.zeros(n))  # standard deviation of the field under its prior
        self.register_buffer("noise_db", torch.ones(n))  # of a packet about the field
        self.level = nn.Parameter(torch.zeros(n))  # T [dBm]
        self.slope = nn.Parameter(torch.zeros(n))  # -10 gamma [dB a decade]
        self.directivity = nn.Parameter(torch.zeros(n, HARMONICS))  # in units of its prior deviation
        local = (anchor.double() - self.centre).float()
        few = local[:: max(1, len(local) // UNCERTAINTY_ANCHORS)]
        self.register_buffer("few", few)
        gram = kernel(few.double(), few.double())
        precision = torch.linalg.inv(gram + kernel.noise * torch.eye(len(gram), dtype=gram.dtype))
        self.register_buffer("precision", precision.float())
        self.field = SmoothField(local, replace(kernel, noise=JITTER), n * rank)
        self.primitives = Primitives(n_primitives, GRID, generator=generator, scenes=(n,))
        self.basis = nn.Parameter(1 + 0.3 * torch.randn(n, rank, n_primitives, generator=generator))
        self.primitives.requires_grad_(config.learn_shapes)
        self.basis.requires_grad_(config.learn_shapes)
        for parameter in (self.level, self.slope, self.directivity):
            parameter.requires_grad_(config.law)

    receiver: Tensor
    centre: Tensor
    field_db: Tensor
    noise_db: Tensor
    few: Tensor
    precision: Tensor

    def harmonics(self, position: Tensor) -> Tensor:
        """Harmonics of degree 1 and 2 of the direction from each receiver, of unit mean square, (B, R, 8)."""
        x, y, z = functional.normalize(position[:, None] - self.receiver, dim=-1).float().unbind(-1)
        first = [math.sqrt(3) * c for c in (x, y, z)]
        second = [math.sqrt(15) * c for c in (x * y, y * z, z * x, (x * x - y * y) / 2)]
        return torch.stack([*first, *second, math.sqrt(5) / 2 * (3 * z * z - 1)], dim=-1)

    def prior(self) -> Tensor:
        """Negative log prior of the functions of position and of the directivity."""
        return 0.5 * (self.field.prior() + self.directivity.square().sum())

    def forward(self, position: Tensor) -> Tensor:
        """RSSI float32 (B, R) [dBm] at positions (B, 3) [m], float64."""
        law = self.level + self.slope * log_distance(position, self.receiver).float()
        law = law + DIRECTIVITY_DB * torch.einsum("brh,rh->br", self.harmonics(position), self.directivity)
        if not len(self.primitives):
            return law
        drawn = self._draw()  # (R, 1 + K, 2, pixels): the canonical field and the K that move it
        motion = self.field((position - self.centre).float()).reshape(len(position), -1, self.rank)
        moved = drawn[:, 0] + torch.einsum("brk,rkcp->brcp", motion, drawn[:, 1:])
        pooled = magnitude(moved[..., None]).mean(dim=(-2, -1))
        canonical = magnitude(drawn[:, 0, :, :, None]).mean(dim=(-2, -1)) if self.on_law else 1.0
        return law + SCALE * (pooled - canonical)

    def _draw(self) -> Tensor:
        """Canonical and basis fields, the latter scaled so that to first order RSSI has the prior's deviation."""
        mean, cholesky, attenuation, response = self.primitives()
        weight = attenuation[:, None, :, None] * torch.cat(
            [response[:, None], self.basis[..., None] * response[:, None]], dim=1
        )  # (R, 1 + K, N, 2)
        shape = weight.shape[:2]
        means, choleskys = (x[:, None].expand(*shape, -1, -1) for x in (mean, cholesky))
        drawn = rasterize(means, choleskys, weight, GRID).flatten(-2)
        canonical, basis = drawn[:, :1], drawn[:, 1:]
        phase = canonical / magnitude(canonical[..., None]).squeeze(-1).unsqueeze(-2).clamp_min(1e-6)
        gain = SCALE * (phase * basis).sum(dim=-2).mean(dim=-1)  # (R, K) dB for a unit of each function
        scale = self.field_db / gain.norm(dim=-1).clamp_min(1e-6)
        return torch.cat([canonical, scale[:, None, None, None] * basis], dim=1)

    def deviation(self, position: Tensor) -> Tensor:
        """Standard deviation of a measurement about the prediction, (B, R) [dB]: packet noise, and the field's
        uncertainty, which grows away from measured positions."""
        cross = self.kernel((position - self.centre).float(), self.few)
        unknown = (1 - (cross @ self.precision * cross).sum(dim=1)).clamp(0, 1)
        return (self.noise_db**2 + self.field_db**2 * unknown[:, None]).sqrt()


class RssiModel(nn.Module):
    """RSSI at R receivers for any position of the transmitter; what `fit_rssi` returns.

    Args:
        groups: of receivers, in their order.
    """

    def __init__(self, groups: Sequence[ReceiverGroup]) -> None:
        super().__init__()
        self.groups = nn.ModuleList(groups)
        self.register_buffer("widening", torch.ones(()))  # half of the interval in standard deviations

    widening: Tensor

    @property
    def n_primitives(self) -> int:
        """A receiver; 0 where the log-distance law is all."""
        return len(cast(ReceiverGroup, self.groups[0]).primitives)

    def forward(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """RSSI and the standard deviation of a measurement about it, (B, R) [dBm] and [dB], at positions (B, 3) [m]."""
        groups = [cast(ReceiverGroup, group) for group in self.groups]
        return tuple(torch.cat([f(position) for f in fs], dim=1) for fs in (groups, [g.deviation for g in groups]))  # type: ignore[return-value]

    @torch.no_grad()
    def predict(self, position: Tensor, batch: int = 2048) -> tuple[Tensor, Tensor, Tensor]:
        """RSSI at any positions, with an interval for a measurement there.

        Args:
            position: of the transmitter [m], (n, 3).
            batch: positions at a time, which bounds the memory.

        Returns:
            Prediction, lower and upper end of the interval, each float32 (n, R) [dBm].

        Raises:
            InputError: positions of another shape, or not finite.
        """
        position = check_positions(position)
        if not len(position):
            return (torch.empty(0, sum(len(cast(ReceiverGroup, group).receiver) for group in self.groups)),) * 3
        middle, deviation = (torch.cat(x) for x in zip(*(self(p) for p in position.split(batch)), strict=True))
        return middle, middle - self.widening * deviation, middle + self.widening * deviation


def fit_rssi(
    train: Rssi, config: RssiConfig | None = None, *, device: torch.device | str = "cpu", parallel: Map = map
) -> RssiModel:
    """Fits all receivers at once; same data, configuration and machine give the same model.

    The kernel, and whether there are primitives at all, are chosen by cross-validation on what the log-distance law leaves;
    the width of the interval on one held-out fold of the training rows.

    Args:
        train: the only rows it sees; a receiver's missing values do not count.
        config: how; `RssiConfig()` unless given.
        device: where to optimise; the model that comes back is on the CPU.
        parallel: maps the fit over groups of receivers; give one that spreads work over processes or machines.

    Raises:
        InputError: a receiver heard in too few rows.
        FitError: a loss that is not finite.
    """
    config = config or RssiConfig()
    for name, count in zip(train.receiver_names, (~train.rssi_dbm.isnan()).sum(dim=0).tolist(), strict=True):
        if count < MIN_TRAINING:
            raise InputError(f"receiver {name!r} is heard in {count} training rows; at least {MIN_TRAINING} are needed")
    fold = folds(train.transmitter_position, config.validation, config.seed)
    kernel, helps = _choose_field(train.transmitter_position, _log_distance_law(train)[1], fold)
    rest, held_out = train.subset((fold != 0).nonzero()[:, 0]), train.subset((fold == 0).nonzero()[:, 0])
    task = functools.partial(
        _optimise,
        n_primitives=config.n_primitives if helps or not config.law else 0,
        kernel=kernel,
        config=config,
        device=torch.device(device),
    )
    searched, model = (RssiModel(list(parallel(task, _groups(rows)))) for rows in (rest, train))
    with torch.no_grad():
        predicted, deviation = searched(held_out.transmitter_position)
    standardised = (predicted - held_out.rssi_dbm).abs() / deviation
    model.widening.fill_(standardised[standardised.isfinite()].quantile(config.coverage))
    return model.eval()


def _groups(rows: Rssi) -> list[Rssi]:
    """The receivers in groups of a fixed size, so that the numbers do not depend on who fits which group."""
    columns = list(range(len(rows.receiver_names)))
    return [rows.columns(columns[start : start + GROUP]) for start in range(0, len(columns), GROUP)]


def _choose_field(position: Tensor, residual: Tensor, fold: Tensor) -> tuple[Kernel, bool]:
    """The kernel that best predicts what the log-distance law leaves (n, R) where it is held out, by mean absolute error
    [dB], and whether that is better than leaving it. Missing values count as 0 when they predict; they are not scored."""
    position, residual, fold = thinned(position, residual, fold)
    filled = residual.nan_to_num()

    def missed(kernel: Kernel) -> float:
        parts = held_out_weights(kernel, position, fold)
        return float(torch.cat([(gain @ filled[kept] - residual[out]).abs() for out, kept, gain in parts]).nanmean())

    best = min(candidates(position, NOISES), key=missed)
    return best, missed(best) < float(residual.abs().nanmean())


def _log_distance_law(train: Rssi) -> tuple[Tensor, Tensor]:
    """Level and slope (R, 2) of each receiver by least squares, and what they leave (n, R), nan where not heard."""
    distance = log_distance(train.transmitter_position, train.receiver_position)
    law, residual = torch.zeros(len(train.receiver_names), 2), torch.full_like(train.rssi_dbm, torch.nan)
    for r in range(len(law)):
        heard = ~train.rssi_dbm[:, r].isnan()
        design = torch.stack([torch.ones(int(heard.sum()), dtype=torch.float64), distance[heard, r]], dim=1)
        coefficients = torch.linalg.lstsq(design, train.rssi_dbm[heard, r]).solution
        law[r] = coefficients.float()
        residual[heard, r] = train.rssi_dbm[heard, r] - design @ coefficients
    return law, residual


def _optimise(
    train: Rssi, n_primitives: int, kernel: Kernel, config: RssiConfig, device: torch.device
) -> ReceiverGroup:
    """Maximum a posteriori: Huber's loss in units of the noise, and the prior of the functions of position."""
    generator = torch.Generator().manual_seed(config.seed)
    position, rssi = train.transmitter_position, train.rssi_dbm.float()
    rows = torch.randperm(len(train), generator=generator)[:MAX_ANCHORS].sort().values
    model = ReceiverGroup(train.receiver_position, position[rows], kernel, n_primitives, config)
    law, residual = _log_distance_law(train)
    variance = residual.square().nanmean(dim=0).float().clamp_min(1e-6)
    with torch.no_grad():
        if config.law:
            model.level.copy_(law[:, 0])
            model.slope.copy_(law[:, 1])
        share = kernel.noise / (1 + kernel.noise) if n_primitives else 1.0
        model.noise_db.copy_((share * variance).sqrt())
        model.field_db.copy_(((1 - share) * variance).sqrt())
    model, position, rssi = model.to(device), position.to(device), rssi.to(device)
    optimiser = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], lr=config.rate)
    heard = int((~rssi.isnan()).sum())
    described = f"{len(train.receiver_names)} receivers, {n_primitives} primitives"
    for step in progress(range(config.steps), described):
        batch = torch.randint(len(train), (min(config.batch, len(train)),), generator=generator)
        measured = rssi[batch]
        missed = ((model(position[batch]) - measured) / model.noise_db)[~measured.isnan()]
        loss = functional.huber_loss(missed, torch.zeros_like(missed), delta=config.huber)
        loss = loss + model.prior() / heard
        if not math.isfinite(loss.item()):
            raise FitError(
                f"the RSSI fit broke at step {step}: loss {loss.item():.3g}; try a rate below {config.rate:g}"
            )
        optimiser.zero_grad()
        loss.backward()
        optimiser.param_groups[0]["lr"] = config.rate * 0.5 * (1 + math.cos(math.pi * step / config.steps))
        optimiser.step()
    return model.requires_grad_(False).cpu()
