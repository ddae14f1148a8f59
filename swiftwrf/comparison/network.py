"""Networks that predict spectra: their common interface, and the frames in which they take positions."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any, Self

import torch
from torch import Tensor, nn

from swiftwrf.array.angles import AngularGrid
from swiftwrf.choices import Moving
from swiftwrf.data.spectra import Spectra
from swiftwrf.positions import frame, normalise
from swiftwrf.runtime.checkpoint import Header, expect
from swiftwrf.runtime.descent import Model
from swiftwrf.runtime.validation import check_value


class Network(nn.Module, ABC):
    """Base class of networks that predict spectra.

    Args:
        size: Size of the network.
        grid: Grid of the training spectra.
    """

    def __init__(self, size: Any, grid: AngularGrid) -> None:
        super().__init__()
        self.size, self.grid = size, grid

    @classmethod
    def of(cls, size: Any, train: Spectra) -> Self:
        """Return a network for training spectra, its frame placed; the weights are not initialised."""
        return cls(size, train.grid)

    @classmethod
    def blank(cls, size: Any, grid: AngularGrid, header: Header) -> Self:
        """Return a network of the structure that a file's header describes."""
        return cls(size, grid)

    def header(self) -> Header:
        """Return the plain values that `blank` needs."""
        return {"size": asdict(self.size)}

    @abstractmethod
    def render(self, position: Tensor, grid: AngularGrid, generator: torch.Generator | None = None) -> Tensor:
        """Return magnitudes (b, H, W) at positions (b, 3), float64 [m]; differentiable.

        Args:
            position: Positions of the moving end.
            grid: Directions.
            generator: Source of a random sample. Defaults to the mean.
        """


class Frame(nn.Module):
    """Frame in which positions are normalised: the box around the training positions is centred in [-1, 1]^3."""

    centre: Tensor
    scale: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("centre", torch.zeros(3, dtype=torch.float64))
        self.register_buffer("scale", torch.ones((), dtype=torch.float64))

    def place(self, position: Tensor) -> None:
        """Place the frame at training positions (n, 3) [m]."""
        self.centre, self.scale = frame(position)

    def forward(self, position: Tensor) -> Tensor:
        """Return normalised positions, float32 (n, 3), of positions (n, 3) [m]."""
        return normalise(position.to(self.centre.device), self.centre, self.scale)


class Link(nn.Module):
    """Positions of both ends of the link, relative to the centre of the training positions.

    Args:
        moving: End that moves. The array is at the receiver.
    """

    centre: Tensor
    fixed: Tensor
    rotation: Tensor

    def __init__(self, moving: Moving) -> None:
        super().__init__()
        self.moving = moving
        self.register_buffer("centre", torch.zeros(3, dtype=torch.float64))
        self.register_buffer("fixed", torch.zeros(3, dtype=torch.float64))
        self.register_buffer("rotation", torch.eye(3, dtype=torch.float64))

    def place(self, train: Spectra) -> None:
        """Take over the fixed end and the array's rotation from the data, which must describe them."""
        assert train.fixed_position is not None
        assert train.rotation is not None
        self.centre, _ = frame(train.position)
        self.fixed, self.rotation = train.fixed_position.double(), train.rotation.double()

    def forward(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """Return transmitter and receiver, float32 (n or 1, 3) [m], with the moving end at positions (n, 3) [m]."""
        moved, fixed = (normalise(x.to(self.centre.device), self.centre, 1.0) for x in (position, self.fixed[None]))
        return (moved, fixed) if self.moving == "transmitter" else (fixed, moved)

    def to_world(self, direction: Tensor) -> Tensor:
        """Rotate directions (..., 3) from array to world coordinates, float32."""
        return (direction.to(self.rotation) @ self.rotation.T).float()


class LinkNetwork(Network):
    """Base class of networks that use the positions of both ends.

    Args:
        size, grid: See `Network`.
        moving: End that moves.
    """

    def __init__(self, size: Any, grid: AngularGrid, moving: Moving) -> None:
        super().__init__(size, grid)
        self.link = Link(moving)

    @classmethod
    def of(cls, size: Any, train: Spectra) -> Self:
        network = cls(size, train.grid, train.moving)
        network.link.place(train)
        return network

    @classmethod
    def blank(cls, size: Any, grid: AngularGrid, header: Header) -> Self:
        check_value("moving", header["moving"], Moving)
        return cls(size, grid, header["moving"])

    def header(self) -> Header:
        return super().header() | {"moving": self.link.moving}


def restored(make: Callable[[], Model], tensors: dict[str, Tensor]) -> Model:
    """Return the module that `make` returns, with saved tensors.

    Raises:
        InputError: Tensors are missing or have other shapes. No memory is allocated before this check.
    """
    with torch.device("meta"):
        blank = make()
    expect(tensors, {name: tuple(tensor.shape) for name, tensor in blank.state_dict().items()})
    model = make()
    model.load_state_dict(tensors)
    return model.eval()


def draw_parameters(model: nn.Module, generator: torch.Generator) -> None:
    """Initialise weights and biases of all layers uniformly within 1 / sqrt(inputs), torch's default."""
    for layer in model.modules():
        if isinstance(layer, nn.Linear | nn.Conv2d | nn.ConvTranspose2d):
            inputs, _ = nn.init._calculate_fan_in_and_fan_out(layer.weight)
            for parameter in layer.parameters(recurse=False):
                nn.init.uniform_(parameter, -1 / math.sqrt(inputs), 1 / math.sqrt(inputs), generator=generator)


def chunks(total: int, size: int) -> Iterator[slice]:
    """Return slices of at most `size` that cover a range."""
    return (slice(start, start + size) for start in range(0, total, size))
