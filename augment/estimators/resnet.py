"""ResNet-50 for spectra: one input channel, a small head, and fast convolutions for CPUs."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

FEATURES = 2048  # of a spectrum, behind the last convolution


class Pointwise(nn.Module):
    """A convolution of 1 x 1 as the matrix product that it is, over channels that lie side by side."""

    def __init__(self, inner: nn.Conv2d) -> None:
        super().__init__()
        self.weight, self.stride = inner.weight, inner.stride

    def forward(self, x: Tensor) -> Tensor:
        rows, columns = self.stride
        pixels = x[:, :, ::rows, ::columns].permute(0, 2, 3, 1)
        # of pixels with a stride, a product of more than two dimensions would copy the weights for each spectrum
        product = functional.linear(pixels.flatten(0, 2), self.weight.flatten(1))
        return product.reshape(*pixels.shape[:3], -1).permute(0, 3, 1, 2)


class Neighbours(nn.Module):
    """A convolution that is a matrix product over the neighbours of each pixel where pixels are few, as in the last layers.

    A convolution rearranges its weights for every batch, which there takes longer than to apply them.
    """

    def __init__(self, inner: nn.Conv2d) -> None:
        super().__init__()
        self.weight = inner.weight
        self.size, self.stride, self.around = inner.kernel_size[0], inner.stride[0], int(inner.padding[0])

    def forward(self, x: Tensor) -> Tensor:
        size, stride, around = self.size, self.stride, self.around
        height, width = ((pixels + 2 * around - size) // stride + 1 for pixels in x.shape[2:])
        if len(x) * height * width > len(self.weight):
            return functional.conv2d(x, self.weight, stride=stride, padding=around)
        # rows of the kernel that meet the image, not its padding alone
        first, end = max(0, around - stride * (height - 1)), min(size, x.shape[2] + around)
        padded = functional.pad(x.permute(0, 2, 3, 1), (0, 0, around, around, around, around))
        down, across = stride * (height - 1) + 1, stride * (width - 1) + 1
        neighbours = [
            padded[:, row : row + down : stride, column : column + across : stride]
            for row in range(first, end)
            for column in range(size)
        ]
        weight = self.weight.permute(0, 2, 3, 1)[:, first:end].flatten(1)
        return functional.linear(torch.cat(neighbours, dim=-1), weight).permute(0, 3, 1, 2)


def backbone(products: bool) -> nn.Module:
    """Return ResNet-50 with one input channel and the head.

    With `products`, its pointwise convolutions, two thirds of all, are matrix products, and those over few pixels, too.
    """
    from torchvision.models import resnet50  # takes two seconds, which only a training needs

    network: nn.Module = resnet50(weights=None)
    network.conv1 = nn.Conv2d(1, 64, kernel_size=7, stride=2, padding=3, bias=False)
    last = nn.Linear(256, 3)
    network.fc = nn.Sequential(nn.Linear(FEATURES, 256), nn.ReLU(), last)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    for module in list(network.modules()):
        for name, child in module.named_children():
            if products and isinstance(child, nn.Conv2d):
                setattr(module, name, (Pointwise if child.kernel_size == (1, 1) else Neighbours)(child))
    return network
