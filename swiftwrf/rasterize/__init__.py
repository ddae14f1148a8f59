"""Rasterization of primitives to spectra: one interface, several backends.

| backend     | tensors                      | method                                                       |
|-------------|------------------------------|--------------------------------------------------------------|
| `reference` | any device, float32, float64 | the definition, dense                                        |
| `cpu`       | CPU, float32                 | culled rows, compiled by numba (extra `paper`) at the first use |
| `cuda`      | NVIDIA GPU, float32          | culled tiles, compiled by NVRTC at the first use             |
| `auto`      |                              | the fast backend of device and dtype if available, else `reference` |
"""

from __future__ import annotations

import warnings
from functools import cache, lru_cache
from importlib.util import find_spec
from typing import Annotated, Literal

import torch
from annotated_types import Gt, Lt
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.errors import InputError
from swiftwrf.rasterize import operators, reference
from swiftwrf.runtime.validation import check_value

Backend = Literal["auto", "reference", "cpu", "cuda"]
Cutoff = Annotated[float, Gt(0), Lt(1)] | None
HAS_NUMBA = find_spec("numba") is not None


def rasterize(
    mean: Tensor,
    cholesky: Tensor,
    weight: Tensor,
    grid: AngularGrid,
    backend: Backend = "auto",
    cutoff: float | None = 1e-4,
) -> Tensor:
    """Render the sum of 2D Gaussians on an angular grid (paper, section 4.1).

    Differentiable in mean, cholesky and weight. Leading dimensions are positions. The whole footprint of a primitive is
    rendered, periodic in azimuth and clipped in elevation.

    Args:
        mean: Azimuth and elevation of each primitive [rad], (..., N, 2). Azimuths may be any number of turns away.
        cholesky: l1, l2, l3 of L = [[l1, 0], [l2, l3]] on (azimuth, elevation) [rad], (N, 3) shared by all positions
            or (..., N, 3). l1 and l3 must not be 0; `reference.py` gives the formula.
        weight: Real and imaginary part of delta psi, (..., N, 2).
        grid: Directions to render.
        backend: Implementation; see the table of `swiftwrf.rasterize`. Defaults to "auto".
        cutoff: Kernel values below it count as 0 for every weight, so that weights near 0 keep their exact gradient.
            The error is at most cutoff times the sum of |weight| in reach. None evaluates every kernel everywhere.

    Returns:
        Real and imaginary part of A, (..., 2, n_elevation, n_azimuth).

    Raises:
        InputError: Shapes, dtypes or devices do not match, `cutoff` lies outside (0, 1), or the backend is unavailable
            for these tensors. On the CPU also values that are not finite and zeros on the diagonal of a Cholesky factor.
            On a GPU this check would wait for the device.

    Example:
        >>> import torch
        >>> mean, factor, weight = torch.tensor([[3.1, 0.8]]), torch.tensor([[0.3, 0.0, 0.3]]), torch.tensor([[1.0, 0.0]])
        >>> rasterize(mean, factor, weight, AngularGrid.hemisphere(9, 36)).shape
        torch.Size([2, 9, 36])
    """
    if not _fast(mean, cholesky, weight, backend, cutoff):
        return reference.field(mean, cholesky, weight, grid, cutoff)
    rendered = operators.field(*_one_batch(mean, cholesky, weight), grid, cutoff)
    return rendered.reshape(*mean.shape[:-2], 2, *grid.shape)


def rasterize_magnitude(
    mean: Tensor,
    cholesky: Tensor,
    weight: Tensor,
    grid: AngularGrid,
    backend: Backend = "auto",
    cutoff: float | None = 1e-4,
) -> Tensor:
    """Render the magnitude |A| of the sum of 2D Gaussians, with gradient 0 where A = 0.

    Args and errors are those of `rasterize`.

    Returns:
        Magnitude of A, (..., n_elevation, n_azimuth).

    Example:
        >>> import torch
        >>> mean, factor, weight = torch.tensor([[0.0, 1.0]]), torch.tensor([[0.3, 0.0, 0.3]]), torch.tensor([[0.6, 0.8]])
        >>> spectrum = rasterize_magnitude(mean, factor, weight, AngularGrid(1.0, 0.1, 1, 0.0, 8))
        >>> round(spectrum[0, 0].item(), 3)
        1.0
    """
    if mean.device.type == "cuda" and _fast(mean, cholesky, weight, backend, cutoff):
        rendered = operators.field_magnitude(*_one_batch(mean, cholesky, weight), grid, cutoff)
        return rendered.reshape(*mean.shape[:-2], *grid.shape)
    return operators.magnitude(rasterize(mean, cholesky, weight, grid, backend, cutoff))


def _one_batch(mean: Tensor, cholesky: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the primitives with all positions in one leading dimension."""
    n_position, n = mean.shape[:-2].numel(), mean.shape[-2]
    factor = cholesky.reshape(n_position, n, 3) if cholesky.dim() > 2 else cholesky
    return mean.reshape(n_position, n, 2), factor, weight.reshape(n_position, n, 2)


@lru_cache
def prepare(device: torch.device | str) -> None:
    """Compile the fast backend of a device, so that measured times do not include its compilation.

    Raises:
        InputError: The backend needs a package that is missing.

    Example:
        >>> prepare("cpu")
    """
    backend: Backend = "cuda" if torch.device(device).type == "cuda" else "cpu"
    ones = torch.ones(1, 1, 2, device=device)
    rasterize(ones, torch.ones(1, 3, device=device), ones, AngularGrid(0.0, 1.0, 1, 0.0, 1), backend)


@cache
def _cuda_compiles(device: torch.device) -> bool:
    try:
        operators.backend_module("cuda").kernels(device)
    except InputError as error:
        warnings.warn(f"rendering with the slow backend 'reference': {error}", stacklevel=2)
        return False
    return True


def _available(device: torch.device) -> bool:
    return HAS_NUMBA if device.type == "cpu" else device.type == "cuda" and _cuda_compiles(device)


def _fast(mean: Tensor, cholesky: Tensor, weight: Tensor, backend: Backend, cutoff: float | None) -> bool:
    """Check the arguments of `rasterize`, and return whether the fast backend of the device renders them."""
    check_value("backend", backend, Backend)
    check_value("cutoff", cutoff, Cutoff)
    _check(mean, cholesky, weight)
    if backend == "auto":
        if mean.device.type == "cpu" and mean.dtype == torch.float32 and not HAS_NUMBA:
            warnings.warn(
                "rendering with the slow backend 'reference'; the fast one needs numba: pip install 'swiftwrf-tasks[paper]'",
                stacklevel=3,
            )
        return mean.dtype == torch.float32 and _available(mean.device)
    if backend != "reference" and (mean.device.type != backend or mean.dtype != torch.float32):
        raise InputError(
            f"backend {backend!r} renders float32 tensors on {backend}, got {mean.dtype} on {mean.device}; "
            "move them there or use backend='auto'"
        )
    return backend != "reference"


def _check(mean: Tensor, cholesky: Tensor, weight: Tensor) -> None:
    if mean.dim() < 2 or mean.shape[-1] != 2:
        raise InputError(f"mean must have shape (..., N, 2), got {tuple(mean.shape)}")
    batch, n = mean.shape[:-2], mean.shape[-2]
    if weight.shape != mean.shape:
        raise InputError(f"weight must have mean's shape {tuple(mean.shape)}, got {tuple(weight.shape)}")
    if cholesky.shape not in ((n, 3), (*batch, n, 3)):
        raise InputError(f"cholesky must have shape {(n, 3)} or {(*batch, n, 3)}, got {tuple(cholesky.shape)}")
    for name, tensor in (("cholesky", cholesky), ("weight", weight)):
        if tensor.dtype != mean.dtype or tensor.device != mean.device:
            raise InputError(
                f"{name} is {tensor.dtype} on {tensor.device} but mean is {mean.dtype} on {mean.device}; "
                "bring them to one dtype and device"
            )
    if not mean.is_floating_point():
        raise InputError(f"mean, cholesky and weight must be floating point, got {mean.dtype}")
    if mean.device.type == "cpu":
        for name, tensor in (("mean", mean), ("cholesky", cholesky), ("weight", weight)):
            if not torch.isfinite(tensor).all():
                raise InputError(f"{name} contains a value that is not finite; its primitive would not be rendered")
        if n and bool((cholesky[..., ::2] == 0).any()):
            raise InputError(
                "a Cholesky factor has a zero on its diagonal (a primitive of no width); keep l1 and l3 away from 0"
            )


__all__ = ["Backend", "prepare", "rasterize", "rasterize_magnitude"]
