"""Networks of convolutions that halve and double spectra, periodic in azimuth: the common part of VAE and DCGAN."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor, nn

from swiftwrf.array.angles import AngularGrid
from swiftwrf.comparison.base import TrainedModel, Training, draw_parameters
from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError

MIN_HALVED_PIXELS = 4  # rows or columns that are still halved

Shape = tuple[int, int]
Norm = Callable[[int], nn.Module]
Objective = Callable[[nn.ModuleDict, Tensor, Tensor, torch.Generator], Tensor]


def stages(grid: AngularGrid) -> list[Shape]:
    """Return rows and columns of the spectra and of each halving, the smallest last.

    Raises:
        InputError: The spectra are too small.
    """
    shapes = [grid.shape]
    while len(shapes) <= 4 and min(shapes[-1]) >= MIN_HALVED_PIXELS:
        shapes.append((-(-shapes[-1][0] // 2), -(-shapes[-1][1] // 2)))
    if len(shapes) == 1:
        least, found = MIN_HALVED_PIXELS, " x ".join(map(str, grid.shape))
        raise InputError(f"convolutions need spectra of at least {least} x {least} pixels, got {found}")
    return shapes


def halve(inputs: int, outputs: int, shape: Shape) -> nn.Sequential:
    """Return a convolution from (B, inputs, H, W) = (B, inputs, *shape) to (B, outputs, ceil(H / 2), ceil(W / 2))."""
    height, width = shape
    wrapped, padded = nn.CircularPad2d((1, 1 + width % 2, 0, 0)), nn.ZeroPad2d((0, 0, 1, 1 + height % 2))
    return nn.Sequential(wrapped, padded, nn.Conv2d(inputs, outputs, kernel_size=4, stride=2))


def double(inputs: int, outputs: int, before: Shape, after: Shape) -> nn.Sequential:
    """Return a transposed convolution from (B, inputs, *before) to (B, outputs, *after), where after is at most doubled."""
    upwards = nn.ConvTranspose2d(inputs, outputs, kernel_size=4, stride=2, padding=(1, 3))
    cropped = nn.ZeroPad2d((0, after[1] - 2 * before[1], 0, after[0] - 2 * before[0]))
    return nn.Sequential(nn.CircularPad2d((1, 1, 0, 0)), upwards, cropped)


def encoder(grid: AngularGrid, width: int, norm: Norm = nn.Identity) -> tuple[nn.Sequential, int]:
    """Return a network from spectra (B, 1, H, W) to (B, features), and the number of features.

    Args:
        grid: Grid of the spectra.
        width: Channels after the first halving; each further halving doubles them.
        norm: Normalisation of a number of channels, after each layer but the first.
    """
    shapes = stages(grid)
    channels = [1, *(width * 2**i for i in range(len(shapes) - 1))]
    layers: list[nn.Module] = []
    for i, ((before, after), shape) in enumerate(zip(pairwise(channels), shapes, strict=False)):
        layers += [halve(before, after, shape), *([norm(after)] if i else []), nn.LeakyReLU(0.2)]
    height, breadth = shapes[-1]
    return nn.Sequential(*layers, nn.Flatten()), channels[-1] * height * breadth


def decoder(grid: AngularGrid, width: int, inputs: int, norm: Norm = nn.Identity) -> nn.Sequential:
    """Return a network from (B, inputs) to magnitudes (B, 1, H, W) in [0, 1]; see `encoder` for the other arguments."""
    shapes = stages(grid)
    channels = [width * 2**i for i in reversed(range(len(shapes) - 1))]
    height, breadth = shapes[-1]
    first = nn.Linear(inputs, channels[0] * height * breadth)
    layers: list[nn.Module] = [first, nn.Unflatten(1, (channels[0], height, breadth)), norm(channels[0]), nn.ReLU()]
    for (before, after), (small, large) in zip(pairwise(channels), pairwise(shapes[:0:-1]), strict=True):
        layers += [double(before, after, small, large), norm(after), nn.ReLU()]
    return nn.Sequential(*layers, double(channels[-1], 1, shapes[1], shapes[0]), nn.Sigmoid())


def paired_training(
    model: TrainedModel,
    train: Spectra,
    device: torch.device,
    objective: Objective,
    betas: tuple[float, float] = (0.9, 0.99),
) -> Training[nn.ModuleDict]:
    """Return the training of a network on pairs of spectrum and position.

    Args:
        model: Model of the network, which is a `torch.nn.ModuleDict`.
        train: Training spectra.
        device: Device to compute on.
        objective: Function from the network, spectra (B, H, W), positions (B, 3) and a random generator to the loss.
        betas: Option of Adam.
    """
    network = model.blank()
    assert isinstance(network, nn.ModuleDict)
    draw_parameters(network, torch.Generator().manual_seed(model.config.seed))
    position, spectrum = train.position, train.spectrum.to(device)

    def loss(network: nn.ModuleDict, generator: torch.Generator) -> Tensor:
        row = torch.randint(len(position), (model.config.batch,), generator=generator)
        return objective(network, spectrum[row.to(device)], position[row], generator)

    return Training(model.config, network.to(device), loss, betas=betas)
