"""The base of all methods of comparison: options, training, and the field model of a trained network."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from typing import Annotated, Any, ClassVar, Self

import numpy as np
import torch
from annotated_types import Ge, Le, Lt
from torch import Tensor, nn

from swiftwrf.array.angles import AngularGrid
from swiftwrf.data.spectra import Spectra, fingerprint
from swiftwrf.models.base import CPU, FieldModel
from swiftwrf.models.link import Linked
from swiftwrf.positions import centre_and_half_side, normalise
from swiftwrf.runtime.descent import Descent, Model, warm_cosine
from swiftwrf.runtime.validation import Fraction, NonNegativeInt, PositiveFloat, PositiveInt, configuration

# sizes of networks, limited because a damaged file may claim any
Count = Annotated[int, Ge(1), Le(2**24)]
Depth = Annotated[int, Ge(1), Le(64)]


@configuration
class Config:
    """Training of a method. The defaults of each method are its quick preset, `paper()` its publication."""

    published: ClassVar[dict[str, Any]] = {}
    """options of the publication"""

    steps: PositiveInt = 1000
    """number of Adam steps"""
    batch: PositiveInt = 16
    """spectra per step"""
    rate: PositiveFloat = 1e-3
    """peak learning rate"""
    warm_up: NonNegativeInt = 50
    """steps over which the rates rise"""
    final_rate: Fraction = 0.02
    """final fraction of the rates after cosine decay"""
    decay_steps: PositiveInt | None = None
    """steps of the decay, after which the cosine continues; None takes all steps"""
    averaging: Annotated[float, Ge(0), Lt(1)] = 0.98
    """decay per step of the weights in the averaged parameters; 0 takes the last parameters"""
    clip: PositiveFloat = 1.0
    """maximum norm of the gradient"""
    check_every: PositiveInt = 50
    """steps between two evaluations, at which a record is sent and the state is saved"""
    seed: NonNegativeInt = 0
    """seed of everything random"""

    @classmethod
    def paper(cls, **changes: Any) -> Self:
        """Return size and training of the publication, with changes."""
        return cls(**cls.published | changes)


class Training(Descent[Model]):
    """Training of a network.

    Each step has its own random generator, so that a training that continues from a checkpoint gives the same result.

    Args:
        config: Options.
        network: Initialised network, on its device.
        loss: Function from the network and the random generator of a step to the loss.
        groups: Parameter groups of Adam. Defaults to all parameters with the configuration's rate.
        betas, weight_decay: Options of Adam.
    """

    def __init__(
        self,
        config: Config,
        network: Model,
        loss: Callable[[Model, torch.Generator], Tensor],
        groups: Iterable[dict[str, Any]] = (),
        *,
        betas: tuple[float, float] = (0.9, 0.99),
        weight_decay: float = 0.0,
    ) -> None:
        every = {"params": list(network.parameters()), "peak": config.rate}
        shared = {name: getattr(config, name) for name in ("steps", "check_every", "averaging", "clip")}
        super().__init__("final", network, list(groups) or [every], betas=betas, weight_decay=weight_decay, **shared)
        self.config, self.loss = config, loss

    def objective(self) -> Tensor:
        return self.loss(self.model, self.generator())

    def rate(self, step: int) -> float:
        config = self.config
        return warm_cosine(step, config.decay_steps or config.steps, config.warm_up, config.final_rate)

    def generator(self) -> torch.Generator:
        """Return the random generator of the next step."""
        (state,) = np.random.SeedSequence((self.config.seed, self.step)).generate_state(1)
        return torch.Generator().manual_seed(int(state))


class TrainedModel(Linked, FieldModel):
    """Field model of a trained network.

    A subclass sets a `config_type` that derives from `Config`, and implements `blank`, `training` and `render`. If it
    requires the fixed end, it finds both ends of the link in the frame of the training positions by `ends`.
    """

    slow = True

    saved = "network"
    network: nn.Module
    """trained network; the gradients of its parameters are off"""

    @abstractmethod
    def blank(self, saved: Mapping[str, Tensor] | None = None) -> nn.Module:
        """Return a network of the options on the grid, its weights not initialised.

        Args:
            saved: Tensors that the network will take over, if their number depends on the training.
        """

    @abstractmethod
    def training(self, train: Spectra, device: torch.device) -> Training[Any]:
        """Return the training of a new network."""

    @abstractmethod
    def render(self, network: Any, position: Tensor, grid: AngularGrid) -> Tensor:
        """Return magnitudes (b, H, W) at positions (b, 3), float64 [m]; differentiable."""

    def _fit(self, train: Spectra, *, device: torch.device = CPU, **arguments: Any) -> None:
        owner = fingerprint(train, type(self).__name__, asdict(self.config))
        self.network = self.training(train, device).run(owner, **arguments)

    def local(self, position: Tensor, device: torch.device) -> Tensor:
        """Return positions, float32 (n, 3) within [-1, 1]^3 in the box around the training positions, on a device."""
        centre, scale = centre_and_half_side(self.bounds)
        return normalise(position.to(device), centre.to(device), scale.to(device))

    def ends(self, position: Tensor, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return transmitter and receiver, float32 (n or 1, 3) [m from the centre], with the moving end at positions."""
        centre = centre_and_half_side(self.bounds)[0].to(device)
        moved, fixed = (normalise(x.to(device), centre, 1.0) for x in (position, self.fixed_position[None]))
        return (moved, fixed) if self.moving == "transmitter" else (fixed, moved)

    def parameters(self) -> Iterable[Tensor]:
        return self.network.parameters()

    def _predict(self, position: Tensor, grid: AngularGrid, with_std: bool) -> tuple[Tensor, Tensor | None]:
        return self.render(self.network, position, grid), None
