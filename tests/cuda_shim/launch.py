"""Render hard cases with the CUDA backend through `cuda.bindings` and a stand-in driver that lies in the library path."""

import contextlib
import itertools
from types import SimpleNamespace
from unittest import mock

import torch
from hard_cases import (
    GRADIENT_TOLERANCE,
    HARD_CASES,
    VALUE_TOLERANCE,
    Case,
    field_errors,
    magnitude_errors,
    random_scene,
)

from swiftwrf import AngularGrid
from swiftwrf.contrib.rasterize import cuda
from swiftwrf.rasterize import operators

torch.cuda.get_device_capability = lambda device: (9, 0)
torch.cuda.device = lambda device: contextlib.nullcontext()
torch.cuda.current_device = lambda: 0
torch.cuda.current_stream = lambda: SimpleNamespace(cuda_stream=0x123456789ABC)
torch.use_deterministic_algorithms(True)  # fills fresh memory with not-a-number
grid = AngularGrid.hemisphere(17, 33)
small = [case for case in HARD_CASES.values() if case.mean.shape[1] < 10]
cases = [*itertools.product(small, (None, 1e-4))]
for per_position, cutoff in ((True, 1e-4), (False, None)):
    inputs = (x.detach() for x in random_scene(100, 2, per_position=per_position, grid=grid))
    cases.append((Case("more than a batch", *inputs, grid), cutoff))
with mock.patch.dict(operators.BACKENDS, cpu=cuda.__name__):
    for case, cutoff in cases:
        for value, gradient in (
            field_errors(operators.field, case, cutoff),
            magnitude_errors(operators.field_magnitude, case, cutoff),
        ):
            assert value < VALUE_TOLERANCE[cutoff] * case.slack, case
            assert gradient < GRADIENT_TOLERANCE[cutoff] * case.slack, case
    for batch, n in ((2, 0), (0, 4)):
        nothing = torch.zeros(batch, n, 2), torch.ones(n, 3), torch.zeros(batch, n, 2)
        assert not operators.field(*nothing, grid, 1e-4).any()
try:
    cuda.kernels(torch.device("cpu")).launch("other", 1, 32)
except cuda.CudaUnavailable as error:
    print(error)
