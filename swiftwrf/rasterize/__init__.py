"""Primitives to spectrum: one contract, several makers.

| maker       | where                        | what                                                            |
|-------------|------------------------------|-----------------------------------------------------------------|
| `reference` | any device, float32, float64 | the definition, dense                                           |
| `cpu`       | CPU, float32                 | culled rows, compiled by numba at first use                     |
| `cuda`      | NVIDIA GPU, float32          | culled tiles, compiled at first use by the NVRTC of torch       |
| `auto`      |                              | the fast one for the tensors' device and dtype, else `reference`|
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal, get_args

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.errors import InputError
from swiftwrf.rasterize import cuda, reference
from swiftwrf.rasterize.magnitude import magnitude

Maker = Literal["auto", "reference", "cpu", "cuda"]


def rasterize(
    mean: Tensor,
    cholesky: Tensor,
    weight: Tensor,
    grid: AngularGrid,
    maker: Maker = "auto",
    cutoff: float | None = 1e-4,
) -> Tensor:
    """Sum of 2D Gaussians on an angular grid (paper, section 4.1).

    Differentiable in mean, cholesky and weight. Leading dimensions are positions; a primitive's whole footprint is
    drawn, periodic in azimuth, clipped in elevation.

    Args:
        mean: azimuth and elevation of each primitive [rad], (..., N, 2); azimuths may be any number of turns away.
        cholesky: l1, l2, l3 of L = [[l1, 0], [l2, l3]] on (azimuth, elevation) [rad], (N, 3) shared by all positions
            or (..., N, 3); l1 and l3 not zero (their sign changes L, see the formula in `reference.py`).
        weight: delta psi, real and imaginary part, (..., N, 2).
        grid: the directions to draw.
        maker: who draws; see the table above.
        cutoff: kernel values below it count as 0, whatever the weight, so that weights near 0 keep their exact
            gradient; None draws everything. The error is at most cutoff * sum |weight| in reach.

    Returns:
        Real and imaginary part of A, (..., 2, n_elevation, n_azimuth).

    Raises:
        InputError: shapes, dtypes or devices that do not fit, a cutoff outside (0, 1), a maker that cannot draw these
            tensors or cannot be built here, or (outside compiled and CUDA code, where looking would wait for the device)
            a value that is not finite or a zero on a Cholesky factor's diagonal.
    """
    _check(mean, cholesky, weight, cutoff)
    chosen = _choose(maker, mean)
    if chosen == "reference":
        return reference.rasterize(mean, cholesky, weight, grid, cutoff)
    flat = _flattened(mean, cholesky, weight)
    if chosen == "cuda":
        drawn = cuda.rasterize(*flat, grid, cutoff)
    else:
        from swiftwrf.rasterize import cpu  # numba is imported by those who use it

        drawn = cpu.rasterize(*flat, grid, cutoff)
    return drawn.reshape(*mean.shape[:-2], 2, *grid.shape)


def rasterize_magnitude(
    mean: Tensor,
    cholesky: Tensor,
    weight: Tensor,
    grid: AngularGrid,
    maker: Maker = "auto",
    cutoff: float | None = 1e-4,
) -> Tensor:
    """|A| of what `rasterize` draws, (..., n_elevation, n_azimuth), with gradient 0 where A = 0; the same arguments and
    errors. The CUDA maker draws it without writing A."""
    if _choose(maker, mean) != "cuda":
        return magnitude(rasterize(mean, cholesky, weight, grid, maker, cutoff))
    _check(mean, cholesky, weight, cutoff)
    drawn = cuda.magnitude(*_flattened(mean, cholesky, weight), grid, cutoff)
    return drawn.reshape(*mean.shape[:-2], *grid.shape)


@lru_cache
def prepare(device: torch.device | str) -> None:
    """Compiles the fast maker for a device, which else is part of the time of whatever is drawn first."""
    one = torch.ones(1, 1, 2, device=device)
    rasterize_magnitude(one, torch.ones(1, 3, device=device), one, AngularGrid(0.0, 1.0, 1, 0.0, 1))


def _flattened(mean: Tensor, cholesky: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """All positions in one leading dimension."""
    n_position, n = mean.shape[:-2].numel(), mean.shape[-2]
    if cholesky.dim() > 2:
        cholesky = cholesky.reshape(n_position, n, 3)
    return mean.reshape(n_position, n, 2), cholesky, weight.reshape(n_position, n, 2)


def _choose(maker: Maker, mean: Tensor) -> str:
    if maker not in get_args(Maker):
        raise InputError(f"unknown maker {maker!r}; choose one of {', '.join(get_args(Maker))}")
    if maker == "auto":
        if mean.dtype != torch.float32 or mean.device.type not in ("cpu", "cuda"):
            return "reference"
        return "reference" if mean.is_cuda and not cuda.available(mean.device) else mean.device.type
    if maker != "reference" and (mean.device.type != maker or mean.dtype != torch.float32):
        raise InputError(
            f"maker {maker!r} draws float32 tensors on {maker}, got {mean.dtype} on {mean.device}; "
            "move them there or use maker='auto'"
        )
    return maker


def _check(mean: Tensor, cholesky: Tensor, weight: Tensor, cutoff: float | None) -> None:
    if cutoff is not None and not 0 < cutoff < 1:
        raise InputError(f"cutoff must lie in (0, 1) or be None, got {cutoff}")
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
    if mean.device.type == "cpu" and not torch.compiler.is_compiling():
        for name, tensor in (("mean", mean), ("cholesky", cholesky), ("weight", weight)):
            if not torch.isfinite(tensor).all():
                raise InputError(f"{name} holds a value that is not finite; a primitive there would silently vanish")
        if n and bool((cholesky[..., ::2] == 0).any()):
            raise InputError(
                "a Cholesky factor has a zero on its diagonal (a primitive of no width); keep l1 and l3 off 0"
            )


__all__ = ["Maker", "prepare", "rasterize", "rasterize_magnitude"]
