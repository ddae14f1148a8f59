"""What all methods share: their sizes and training, the fit, the file, and where the two ends of the link stand."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar, get_args

import numpy as np
import torch
from torch import Tensor, nn

from swiftwrf.angles import AngularGrid
from swiftwrf.checkpoint import Header, Saved, expect
from swiftwrf.data.spectra import Moving, Spectra, check_training, fingerprint
from swiftwrf.errors import InputError
from swiftwrf.fitting.descent import Descent, Model, Schedule, warm_cosine
from swiftwrf.fitting.state import Record, Session
from swiftwrf.model.swiftwrf import frame, normalise
from swiftwrf.positions import check_batch, check_drawn, check_positions
from swiftwrf.progress import progress_bar

LARGEST, MOST_LAYERS = 2**24, 64  # of a model: what a file claims is believed only so far


@dataclass(frozen=True)
class Size:
    """What a model consists of: whole numbers and lengths, all above 0."""

    def check(self) -> None:
        """Refuses what no model can have, wherever it comes from.

        Raises:
            InputError: such a number.
        """
        for field in fields(self):
            value, whole = getattr(self, field.name), type(field.default) is int
            limit = MOST_LAYERS if field.name == "depth" else LARGEST
            right = type(value) is int if whole else type(value) in (int, float)
            if not right or not 0 < value <= limit:
                raise InputError(f"{field.name} must be a number above 0 and at most {limit}, got {value!r}")


AnySize = TypeVar("AnySize", bound=Size)


@dataclass(frozen=True)
class Config(ABC, Generic[AnySize, Model]):
    """How a model is sized and trained; the defaults of each method are its quick preset."""

    size: AnySize
    steps: int
    """of the optimisation"""
    batch: int
    """spectra a step"""
    rate: float
    """largest learning rate"""
    warm_up: int = 50
    """steps over which the rates rise"""
    final_rate: float = 0.02
    """share of the rates that is left when they have decayed"""
    decay_steps: int | None = None
    """steps in which they decay, along a cosine that goes on afterwards; all steps unless given"""
    averaging: float = 0.98
    """by how much a step's weight in the averaged parameters decays a step; 0 keeps the last ones"""
    clip: float = 1.0
    """largest norm of the gradient"""
    check_every: int = 50
    """steps between two evaluations, at which progress is recorded and the state kept"""
    seed: int = 0

    @classmethod
    @abstractmethod
    def paper(cls, **changes: Any) -> Config[AnySize, Model]:
        """The size and the training of the publication."""

    @abstractmethod
    def training(self, train: Any, device: torch.device) -> Training[Any, Model]:
        """At its start."""


AnyConfig = TypeVar("AnyConfig", bound=Config[Any, Any])


class Training(Descent[Model], Generic[AnyConfig, Model]):
    """Trains the model of a configuration.

    Whatever a step draws at random comes from a generator of that step's own, so that a training that goes on draws the
    same.

    Args:
        config: how.
        model: at its start, on its device.
        groups: parameter groups of Adam; all parameters with the configuration's rate unless given.
        betas, weight_decay: of Adam.
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
        own = self.config
        return warm_cosine(step, own.decay_steps or own.steps, own.warm_up, own.final_rate)

    def generator(self) -> torch.Generator:
        """For what the next step draws."""
        (state,) = np.random.SeedSequence((self.config.seed, self.step)).generate_state(1)
        return torch.Generator().manual_seed(int(state))


def descend(
    training: Training[Any, Model],
    owner: str,
    checkpoint: Path | None,
    on_record: Callable[[Record], None] | None,
    progress: bool,
) -> Model:
    """The model after all steps; see `fit`. `owner` is the fingerprint of the fit."""
    with progress_bar(progress) as bar:
        training.run(Session(checkpoint, owner, bar, on_record))
    return training.result.eval()


def fit(
    train: Spectra,
    config: Config[Any, Model],
    *,
    device: torch.device | str = "cpu",
    checkpoint: Path | None = None,
    on_record: Callable[[Record], None] | None = None,
    progress: bool = True,
) -> Model:
    """Fits the model of a configuration to spectra; same data, configuration and machine give the same model.

    Args:
        train: the only spectra it sees.
        config: which method, and how.
        device: where to compute.
        checkpoint: a file that keeps the state of the fit; where it exists, the fit goes on from it.
        on_record: called at each evaluation with stage, step, loss and seconds; a fit that goes on begins with the records
            of its earlier sessions.
        progress: show a progress bar on a terminal.

    Raises:
        InputError: fewer than 10 spectra, something not finite, something that the method needs and the data do not tell,
            or a checkpoint of another fit.
        FitError: a loss or gradient that is not finite (the checkpoint holds the last good state), or a fit that ends
            worse than it began.
    """
    check_training(train)
    owner = fingerprint(train, type(config).__name__, asdict(config))
    return descend(config.training(train, torch.device(device)), owner, checkpoint, on_record, progress)


def restored(make: Callable[[], Model], tensors: dict[str, Tensor]) -> Model:
    """What `make` makes, with these tensors.

    Raises:
        InputError: tensors that are missing or of another shape; found before memory is taken for what is made.
    """
    with torch.device("meta"):  # takes no memory
        blank = make()
    expect(tensors, {name: tuple(tensor.shape) for name, tensor in blank.state_dict().items()})
    model = make()
    model.load_state_dict(tensors)
    return model.eval()


class Drawing(nn.Module, Saved):
    """A model that draws spectra.

    Args:
        size: of the model.
        grid: the grid of the spectra that it was fitted to.
    """

    size_type: ClassVar[type[Size]]

    def __init__(self, size: Any, grid: AngularGrid) -> None:
        super().__init__()
        self.size, self.grid = size, grid

    def state(self) -> tuple[dict[str, Tensor], Header]:
        return self.state_dict(), {"size": asdict(self.size), "grid": asdict(self.grid)}

    @classmethod
    def arguments(cls, header: Header) -> dict[str, Any]:
        """What the class is called with, of a saved header."""
        size = cls.size_type(**header["size"])
        size.check()
        return {"size": size, "grid": AngularGrid(**header["grid"])}

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> Drawing:
        arguments = cls.arguments(header)
        return restored(lambda: cls(**arguments), tensors)

    @torch.no_grad()
    def drawn(self, position: Tensor, grid: AngularGrid, batch: int, draw: Callable[[Tensor], Tensor]) -> Tensor:
        """Spectra of `draw` at any positions, so many at a time.

        Args:
            position: of the moving end [m], (n, 3).
            grid: of the spectra.
            batch: spectra drawn at a time, which bounds the memory.
            draw: from positions (b, 3), float64 on the CPU, to magnitudes (b, H, W).

        Returns:
            Magnitudes clipped to [0, 1], float32 (n, n_elevation, n_azimuth), on the CPU.

        Raises:
            InputError: positions of another shape, or not finite; a batch below 1.
        """
        position = check_positions(position)
        check_batch(batch)
        spectrum = torch.empty(len(position), *grid.shape)
        for start in range(0, len(position), batch):
            spectrum[start : start + batch] = draw(position[start : start + batch]).clamp(0, 1)
        return check_drawn(spectrum)


class Frame(nn.Module):
    """The frame in which positions are normalised: their box is centred in [-1, 1]^3."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("centre", torch.zeros(3, dtype=torch.float64))
        self.register_buffer("scale", torch.ones((), dtype=torch.float64))

    centre: Tensor
    scale: Tensor

    def place(self, position: Tensor) -> None:
        """At training positions (n, 3) [m]."""
        self.centre, self.scale = frame(position)

    def forward(self, position: Tensor) -> Tensor:
        """Normalised positions, float32 (n, 3), of positions (n, 3) [m]."""
        return normalise(position.to(self.centre.device), self.centre, self.scale)


class Link(nn.Module):
    """Where the two ends of the link stand, in metres from the centre of the training positions.

    Args:
        moving: which end moves; the array is at the receiver.
    """

    def __init__(self, moving: Moving) -> None:
        super().__init__()
        self.moving = moving
        self.register_buffer("centre", torch.zeros(3, dtype=torch.float64))
        self.register_buffer("fixed", torch.zeros(3, dtype=torch.float64))
        self.register_buffer("rotation", torch.eye(3, dtype=torch.float64))

    centre: Tensor
    fixed: Tensor
    rotation: Tensor

    @classmethod
    def of(cls, train: Spectra) -> Link:
        """Of the data.

        Raises:
            InputError: they do not say where the fixed end stands and how the array is turned.
        """
        if train.fixed_position is None or train.rotation is None:
            raise InputError(
                f"{train.name} does not say where the fixed end stands and how the array is turned, from which rays start"
            )
        link = cls(train.moving)
        link.centre, _ = frame(train.position)
        link.fixed, link.rotation = train.fixed_position.double(), train.rotation.double()
        return link

    def forward(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """Transmitter and receiver, float32 (n or 1, 3) [m from the centre], with the moving end at positions (n, 3) [m]."""
        moved, fixed = (normalise(x.to(self.centre.device), self.centre, 1.0) for x in (position, self.fixed[None]))
        return (moved, fixed) if self.moving == "transmitter" else (fixed, moved)

    def to_world(self, direction: Tensor) -> Tensor:
        """Directions in array coordinates (..., 3) in those of the world, float32."""
        return (direction.to(self.rotation) @ self.rotation.T).float()


class LinkDrawing(Drawing):
    """One that knows where both ends stand.

    Args:
        size, grid: see `Drawing`.
        moving: which end moves.
    """

    def __init__(self, size: Any, grid: AngularGrid, moving: Moving) -> None:
        super().__init__(size, grid)
        self.link = Link(moving)

    def state(self) -> tuple[dict[str, Tensor], Header]:
        tensors, header = super().state()
        return tensors, header | {"moving": self.link.moving}

    @classmethod
    def arguments(cls, header: Header) -> dict[str, Any]:
        if header["moving"] not in get_args(Moving):
            raise InputError(f"moving must be one of {', '.join(get_args(Moving))}, got {header['moving']!r}")
        return super().arguments(header) | {"moving": header["moving"]}


def draw_parameters(model: nn.Module, generator: torch.Generator) -> None:
    """Weights and biases of all layers from the generator, uniform within 1 / sqrt(inputs) as torch has them."""
    for layer in model.modules():
        if isinstance(layer, nn.Linear | nn.Conv2d | nn.ConvTranspose2d):
            inputs, _ = nn.init._calculate_fan_in_and_fan_out(layer.weight)
            for parameter in layer.parameters(recurse=False):
                nn.init.uniform_(parameter, -1 / math.sqrt(inputs), 1 / math.sqrt(inputs), generator=generator)


def chunks(total: int, size: int) -> Iterator[slice]:
    """Slices of at most `size` that make up a range."""
    return (slice(start, start + size) for start in range(0, total, size))
