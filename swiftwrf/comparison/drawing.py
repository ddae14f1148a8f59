"""Models that draw spectra: their file, and where the two ends of the link stand."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any, ClassVar, get_args

import torch
from torch import Tensor, nn

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.base import Size
from swiftwrf.data.spectra import Moving, Spectra
from swiftwrf.errors import InputError
from swiftwrf.positions import check_batch, check_drawn, check_positions, frame, normalise
from swiftwrf.runtime.checkpoint import Header, Saved, expect
from swiftwrf.runtime.descent import Model


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
