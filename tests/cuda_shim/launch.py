"""Render with the CUDA backend through `cuda.bindings` and a stand-in driver that lies in the library path."""

import contextlib
from types import SimpleNamespace
from unittest import mock

import torch
from hard_cases import random_scene

from swiftwrf import AngularGrid
from swiftwrf.rasterize import cuda, operators, reference
from swiftwrf.rasterize.operators import magnitude


def with_gradients(field, magnitude, inputs):
    """Return the field, its magnitude, and the gradients of a function of both."""
    return field, magnitude, *torch.autograd.grad(magnitude.square().sum() + field.sum(), inputs)


torch.cuda.get_device_capability = lambda device: (9, 0)
torch.cuda.device = lambda device: contextlib.nullcontext()
torch.cuda.current_device = lambda: 0
torch.cuda.current_stream = lambda: SimpleNamespace(cuda_stream=0x123456789ABC)
grid = AngularGrid.hemisphere(17, 33)
inputs = random_scene(4, 2, grid=grid)
exact = reference.field(*inputs, grid, 1e-4)
with mock.patch.dict(operators.BACKENDS, cpu=cuda.__name__):
    drawn = operators.field(*inputs, grid, 1e-4), operators.field_magnitude(*inputs, grid, 1e-4)
    found = with_gradients(*drawn, inputs)
for value, expected in zip(found, with_gradients(exact, magnitude(exact), inputs), strict=True):
    torch.testing.assert_close(value, expected, atol=1e-3, rtol=1e-3)
try:
    cuda.kernels(torch.device("cpu")).launch("other", 1, 32)
except cuda.CudaUnavailable as error:
    print(error)
