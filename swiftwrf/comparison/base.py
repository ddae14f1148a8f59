"""The base of all methods of comparison: options, training, and the field model of a trained network."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, TypeVar, get_type_hints

import numpy as np
import torch
from annotated_types import Ge, Le, Lt
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.network import Network, restored
from swiftwrf.data.spectra import Spectra, fingerprint
from swiftwrf.models.base import FieldModel, FitContext
from swiftwrf.runtime.checkpoint import Header
from swiftwrf.runtime.descent import Descent, Model, Schedule, warm_cosine
from swiftwrf.runtime.options import from_plain
from swiftwrf.runtime.progress import progress_bar
from swiftwrf.runtime.session import Record, Session
from swiftwrf.runtime.validation import Fraction, NonNegativeInt, PositiveFloat, PositiveInt, configuration

# sizes of networks, limited because a damaged file may claim any
Count = Annotated[int, Ge(1), Le(2**24)]
Depth = Annotated[int, Ge(1), Le(64)]


@configuration
class Config(ABC):
    """Size and training of a method. The defaults of each method are its quick preset, `paper()` its publication.

    Example:
        >>> from swiftwrf.comparison import VaeConfig
        >>> VaeConfig().steps, isinstance(VaeConfig.paper(), Config)
        (1000, True)
    """

    size: Any = None
    """size of the network"""
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
    @abstractmethod
    def paper(cls, **changes: Any) -> Config:
        """Return size and training of the publication."""

    @abstractmethod
    def training(self, train: Any, device: torch.device) -> Training[Any, Any]:
        """Return the training of a new network."""


AnyConfig = TypeVar("AnyConfig", bound=Config)


class Training(Descent[Model], Generic[AnyConfig, Model]):
    """Training of the network of a configuration.

    Each step has its own random generator, so that a training that continues from a checkpoint gives the same result.

    Args:
        config: Options.
        model: Initialised network, on its device.
        groups: Parameter groups of Adam. Defaults to all parameters with the configuration's rate.
        betas, weight_decay: Options of Adam.
    """

    def __init__(
        self,
        config: AnyConfig,
        model: Model,
        groups: Iterable[dict[str, Any]] | None = None,
        *,
        betas: tuple[float, float] = (0.9, 0.99),
        weight_decay: float = 0.0,
    ) -> None:
        schedule = Schedule(config.steps, config.check_every, config.averaging, config.clip, betas, weight_decay)
        super().__init__(
            "final", model, groups or [{"params": list(model.parameters()), "peak": config.rate}], schedule
        )
        self.config = config

    def rate(self, step: int) -> float:
        config = self.config
        return warm_cosine(step, config.decay_steps or config.steps, config.warm_up, config.final_rate)

    def generator(self) -> torch.Generator:
        """Return the random generator of the next step."""
        (state,) = np.random.SeedSequence((self.config.seed, self.step)).generate_state(1)
        return torch.Generator().manual_seed(int(state))


def descend(
    training: Training[Any, Model],
    owner: str,
    checkpoint: Path | None,
    on_record: Callable[[Record], None] | None,
    progress: bool,
) -> Model:
    """Return the trained network; `owner` is the fingerprint of the fit, the other arguments are those of a fit."""
    with progress_bar(progress) as bar:
        training.run(Session(checkpoint, owner, bar, on_record))
    return training.result.eval()


class TrainedModel(FieldModel):
    """Field model of a trained network.

    A subclass sets `network_type` and a `config_type` that derives from `Config`.

    Example:
        >>> import swiftwrf
        >>> issubclass(swiftwrf.comparison.Vae, TrainedModel)
        True
    """

    network_type: ClassVar[type[Any]]
    slow = True

    network: Network
    """trained network; the gradients of its parameters are off after a fit"""

    def _fit(self, train: Spectra, context: FitContext) -> None:
        owner = fingerprint(train, type(self).__name__, asdict(self.config))
        training = self.config.training(train, context.device)
        network = descend(training, owner, context.checkpoint, context.on_record, context.progress)
        self.network = network.requires_grad_(False)

    def parameters(self) -> Iterable[Tensor]:
        return self.network.parameters()

    def _predict(self, position: Tensor, grid: AngularGrid, with_std: bool) -> tuple[Tensor, Tensor | None]:
        return self.network.render(position, grid), None

    def _sample(self, position: Tensor, grid: AngularGrid, generator: torch.Generator) -> Tensor:
        return self.network.render(position, grid, generator)

    def _state(self) -> tuple[dict[str, Tensor], Header]:
        return self.network.state_dict(), self.network.header()

    def _restore(self, tensors: dict[str, Tensor], header: Header) -> None:
        size = from_plain(get_type_hints(self.config_type)["size"], header["size"])
        network: Network = restored(lambda: self.network_type.blank(size, self.grid, header), tensors)
        self.network = network.requires_grad_(False)
