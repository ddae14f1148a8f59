"""Networks of convolutions that halve and double spectra, periodic in azimuth: the common part of VAE and DCGAN."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, Self, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.base import AnyConfig, Count, Training
from swiftwrf.comparison.network import Frame, Network, draw_parameters
from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError
from swiftwrf.models.mlp import encode
from swiftwrf.runtime.validation import configuration

MAX_HALVINGS = 4
MIN_HALVED_PIXELS = 4  # rows or columns that are still halved

Shape = tuple[int, int]
Norm = Callable[[int], nn.Module]


def stages(grid: AngularGrid) -> list[Shape]:
    """Return rows and columns of the spectra and of each halving, the smallest last.

    Raises:
        InputError: The spectra are too small.
    """
    shapes = [grid.shape]
    while len(shapes) <= MAX_HALVINGS and min(shapes[-1]) >= MIN_HALVED_PIXELS:
        shapes.append((-(-shapes[-1][0] // 2), -(-shapes[-1][1] // 2)))
    if len(shapes) == 1:
        least, found = MIN_HALVED_PIXELS, " x ".join(map(str, grid.shape))
        raise InputError(f"convolutions need spectra of at least {least} x {least} pixels, got {found}")
    return shapes


class Halve(nn.Conv2d):
    """Convolution from (B, inputs, H, W) to (B, outputs, ceil(H / 2), ceil(W / 2))."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, kernel_size=4, stride=2)

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[-2:]
        x = functional.pad(x, (1, 1 + width % 2, 0, 0), mode="circular")
        return super().forward(functional.pad(x, (0, 0, 1, 1 + height % 2)))


class Double(nn.ConvTranspose2d):
    """Transposed convolution from (B, inputs, H, W) to (B, outputs, *shape), where shape is at most (2 H, 2 W)."""

    def __init__(self, inputs: int, outputs: int, shape: Shape) -> None:
        super().__init__(inputs, outputs, kernel_size=4, stride=2, padding=(1, 3))
        self.shape = shape

    def forward(self, x: Tensor) -> Tensor:  # type: ignore[override]  # no other output size
        doubled = super().forward(functional.pad(x, (1, 1, 0, 0), mode="circular"))
        return doubled[..., : self.shape[0], : self.shape[1]]


def encoder(grid: AngularGrid, width: int, inputs: int, norm: Norm = nn.Identity) -> tuple[nn.Sequential, int]:
    """Return a network from (B, inputs, H, W) to (B, features), and the number of features.

    Args:
        grid: Grid of the spectra.
        width: Channels after the first halving; each further halving doubles them.
        inputs: Input channels.
        norm: Normalisation of a number of channels, after each layer but the first.
    """
    shapes = stages(grid)
    channels = [inputs, *(width * 2**i for i in range(len(shapes) - 1))]
    layers: list[nn.Module] = []
    for i, (before, after) in enumerate(pairwise(channels)):
        layers += [Halve(before, after), *([norm(after)] if i else []), nn.LeakyReLU(0.2)]
    height, breadth = shapes[-1]
    return nn.Sequential(*layers, nn.Flatten()), channels[-1] * height * breadth


def decoder(grid: AngularGrid, width: int, inputs: int, norm: Norm = nn.Identity) -> nn.Sequential:
    """Return a network from (B, inputs) to magnitudes (B, 1, H, W) in [0, 1]; see `encoder` for the arguments."""
    shapes = stages(grid)
    channels = [width * 2**i for i in reversed(range(len(shapes) - 1))]
    height, breadth = shapes[-1]
    first = nn.Linear(inputs, channels[0] * height * breadth)
    layers: list[nn.Module] = [first, nn.Unflatten(1, (channels[0], height, breadth)), norm(channels[0]), nn.ReLU()]
    for (before, after), shape in zip(pairwise(channels), shapes[-2:0:-1], strict=True):
        layers += [Double(before, after, shape), norm(after), nn.ReLU()]
    return nn.Sequential(*layers, Double(channels[-1], 1, shapes[0]), nn.Sigmoid())


@configuration
class ConvolutionalSize:
    """Size of VAE and DCGAN."""

    width: Count = 8
    """channels at the finest stage"""
    hidden: Count = 128
    """width of the fully connected layer"""
    bands: Count = 5
    """frequencies of the encoding of the position"""


class ConvolutionalNetwork(Network):
    """Base class of VAE and DCGAN, whose grid is that of the training spectra.

    Args:
        size, grid: See `Network`.
    """

    def __init__(self, size: Any, grid: AngularGrid) -> None:
        super().__init__(size, grid)
        self.frame = Frame()
        self.n_encoded = 3 * (2 * size.bands + 1)

    @classmethod
    def of(cls, size: Any, train: Spectra) -> Self:
        network = cls(size, train.grid)
        network.frame.place(train.position)
        return network

    def encoded(self, position: Tensor) -> Tensor:
        """Return the encoding (B, n_encoded) of positions (B, 3) [m]."""
        return encode(self.frame(position), self.size.bands)


AnyNetwork = TypeVar("AnyNetwork", bound=ConvolutionalNetwork)


class PairedTraining(Training[AnyConfig, AnyNetwork]):
    """Training on pairs of spectrum and position.

    Args:
        config: Options.
        network_type: Class of the network.
        train: Training spectra.
        device: Device to compute on.
        betas: Option of Adam.
    """

    def __init__(
        self,
        config: AnyConfig,
        network_type: type[AnyNetwork],
        train: Spectra,
        device: torch.device,
        betas: tuple[float, float] = (0.9, 0.99),
    ) -> None:
        network = network_type.of(config.size, train)
        draw_parameters(network, torch.Generator().manual_seed(config.seed))
        super().__init__(config, network.to(device), betas=betas)
        self.position, self.spectrum = train.position, train.spectrum.to(device)

    def pairs(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return a batch of spectra (B, H, W) and of encoded positions."""
        row = torch.randint(len(self.position), (self.config.batch,), generator=generator)
        return self.spectrum[row.to(self.spectrum.device)], self.model.encoded(self.position[row])
