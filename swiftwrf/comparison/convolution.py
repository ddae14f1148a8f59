"""Convolutions that halve and double spectra, periodic in azimuth: what VAE and DCGAN are built from."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

from torch import Tensor, nn
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.errors import InputError

STAGES = 4  # halvings at most
SMALLEST = 4  # rows or columns that are still halved

Shape = tuple[int, int]
Norm = Callable[[int], nn.Module]


def stages(grid: AngularGrid) -> list[Shape]:
    """Rows and columns of the spectra and of each halving, the smallest last.

    Raises:
        InputError: spectra too small to be halved.
    """
    shapes = [grid.shape]
    while len(shapes) <= STAGES and min(shapes[-1]) >= SMALLEST:
        shapes.append((-(-shapes[-1][0] // 2), -(-shapes[-1][1] // 2)))
    if len(shapes) == 1:
        raise InputError(
            f"convolutions need spectra of at least {SMALLEST} x {SMALLEST} pixels, got {grid.shape[0]} x {grid.shape[1]}"
        )
    return shapes


class Halve(nn.Conv2d):
    """(B, inputs, H, W) to (B, outputs, ceil(H / 2), ceil(W / 2))."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, kernel_size=4, stride=2)

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[-2:]
        x = functional.pad(x, (1, 1 + width % 2, 0, 0), mode="circular")
        return super().forward(functional.pad(x, (0, 0, 1, 1 + height % 2)))


class Double(nn.ConvTranspose2d):
    """(B, inputs, H, W) to (B, outputs, *shape), where shape is at most (2 H, 2 W)."""

    def __init__(self, inputs: int, outputs: int, shape: Shape) -> None:
        super().__init__(inputs, outputs, kernel_size=4, stride=2, padding=(1, 3))
        self.shape = shape

    def forward(self, x: Tensor) -> Tensor:  # type: ignore[override]  # no other output size
        doubled = super().forward(functional.pad(x, (1, 1, 0, 0), mode="circular"))
        return doubled[..., : self.shape[0], : self.shape[1]]


def encoder(grid: AngularGrid, width: int, inputs: int, norm: Norm = nn.Identity) -> tuple[nn.Sequential, int]:
    """From (B, inputs, H, W) to numbers, and how many.

    Args:
        grid: of the spectra.
        width: channels after the first halving; each further one doubles them.
        inputs: channels that enter.
        norm: what follows a layer of so many channels, the first one excepted.
    """
    shapes = stages(grid)
    channels = [inputs, *(width * 2**i for i in range(len(shapes) - 1))]
    layers: list[nn.Module] = []
    for i, (before, after) in enumerate(pairwise(channels)):
        layers += [Halve(before, after), *([norm(after)] if i else []), nn.LeakyReLU(0.2)]
    height, breadth = shapes[-1]
    return nn.Sequential(*layers, nn.Flatten()), channels[-1] * height * breadth


def decoder(grid: AngularGrid, width: int, inputs: int, norm: Norm = nn.Identity) -> nn.Sequential:
    """From (B, inputs) to magnitudes in [0, 1], (B, 1, H, W); arguments as of `encoder`."""
    shapes = stages(grid)
    channels = [width * 2**i for i in reversed(range(len(shapes) - 1))]
    height, breadth = shapes[-1]
    first = nn.Linear(inputs, channels[0] * height * breadth)
    layers: list[nn.Module] = [first, nn.Unflatten(1, (channels[0], height, breadth)), norm(channels[0]), nn.ReLU()]
    for (before, after), shape in zip(pairwise(channels), shapes[-2:0:-1], strict=True):
        layers += [Double(before, after, shape), norm(after), nn.ReLU()]
    return nn.Sequential(*layers, Double(channels[-1], 1, shapes[0]), nn.Sigmoid())
