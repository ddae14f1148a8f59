"""CUDA backend: compile the kernels of `rasterize.cu` with NVRTC and launch them on torch's current stream.

Both go through the package `cuda.bindings`: neither a CUDA toolkit nor a C++ compiler is needed. Compilation takes about
0.2 s at the first use in a process.

The kernels convert radians to pixels themselves: tensor operations in float64 would cost as much memory traffic as the
rendering. Nothing waits for the device, so calls can be captured in CUDA graphs once the kernels are compiled.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.errors import InputError

SOURCE = Path(__file__).with_name("rasterize.cu")
# With subnormals flushed to zero exp2f is one instruction. Divisions and roots are accurate to two units in the last place.
OPTIONS = ("--std=c++17", "--ftz=true", "--prec-div=false", "--prec-sqrt=false")
MIN_CAPABILITY = 75  # Ten times compute capability 7.5 (Turing), the oldest that NVRTC 13 compiles for.
REMEDY = "use backend='reference' or tensors on the CPU"

# These equal the constants of rasterize.cu.
THREADS_PER_BLOCK, WARPS_PER_BLOCK, THREADS_PER_WARP = 256, 8, 32
TILE_COLUMNS, TILE_ROWS = 16, 8
GATHERING_WARPS = 16

SMALL = 1024  # number of primitives up to which half as many warps a block are faster, on an H100


class CudaUnavailable(InputError):
    """The CUDA backend cannot be compiled or run on this machine."""


def _bindings() -> Any:
    try:
        import cuda.bindings.driver
        import cuda.bindings.nvrtc
    except ImportError as error:
        raise CudaUnavailable(f"backend 'cuda' needs the package cuda-bindings; install it, or {REMEDY}") from error
    return cuda.bindings


def _call(function: Callable[..., tuple[Any, ...]], *arguments: Any) -> Any:
    """Return the result of a function of `cuda.bindings`, whose first return value is a status."""
    try:
        status, *results = function(*arguments)
    except RuntimeError as error:
        library = "NVRTC" if function.__name__.startswith("nvrtc") else "the NVIDIA driver"
        raise CudaUnavailable(f"backend 'cuda' needs {library}, which cuda.bindings does not find; {REMEDY}") from error
    if status.value:
        raise CudaUnavailable(f"{function.__name__} failed with {status.name}; {REMEDY}")
    return results[0] if results else None


def architectures() -> list[int]:
    """Return ten times the compute capabilities that NVRTC compiles for, ascending.

    Raises:
        CudaUnavailable: `cuda.bindings` or NVRTC is missing.
    """
    return sorted(_call(_bindings().nvrtc.nvrtcGetSupportedArchs))


def target(capability: int) -> str:
    """Return the target for ten times a compute capability: machine code, or portable PTX if it is newer than NVRTC.

    Raises:
        CudaUnavailable: The GPU is too old.
    """
    supported = [architecture for architecture in architectures() if MIN_CAPABILITY <= architecture <= capability]
    if not supported:
        raise CudaUnavailable(
            f"backend 'cuda' needs a GPU of compute capability {MIN_CAPABILITY / 10} or more, got {capability / 10}; "
            f"{REMEDY}"
        )
    return f"sm_{capability}" if capability in supported else f"compute_{supported[-1]}"


def compile_source(source: str, target: str, *options: str) -> tuple[bytes, str]:
    """Compile CUDA C++ for a target such as "sm_90" or "compute_90". Needs neither a GPU nor a driver.

    Returns:
        The CUBIN or PTX, and the compiler's log.

    Raises:
        CudaUnavailable: NVRTC is missing, or the source does not compile.
    """
    nvrtc = _bindings().nvrtc
    program = _call(nvrtc.nvrtcCreateProgram, source.encode(), SOURCE.name.encode(), 0, [], [])
    try:
        arguments = [option.encode() for option in (f"--gpu-architecture={target}", *OPTIONS, *options)]
        (status,) = nvrtc.nvrtcCompileProgram(program, len(arguments), arguments)
        log = bytes(_call(nvrtc.nvrtcGetProgramLogSize, program))
        _call(nvrtc.nvrtcGetProgramLog, program, log)
        text = log.rstrip(b"\0").decode(errors="replace").strip()
        if status.value:
            raise CudaUnavailable(f"NVRTC cannot compile the rasterizer for {target}; {REMEDY}: {text or status.name}")
        kind = "CUBIN" if target.startswith("sm_") else "PTX"
        image = bytes(_call(getattr(nvrtc, f"nvrtcGet{kind}Size"), program))
        _call(getattr(nvrtc, f"nvrtcGet{kind}"), program, image)
        return image, text
    finally:
        nvrtc.nvrtcDestroyProgram(program)


class Kernels:
    """The compiled kernels of `rasterize.cu`, loaded on one GPU.

    Raises:
        CudaUnavailable: `cuda.bindings`, NVRTC or the driver is missing, or the GPU is too old.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._driver = _bindings().driver
        major, minor = torch.cuda.get_device_capability(device)
        image, _ = compile_source(SOURCE.read_text(), target(10 * major + minor))
        with torch.cuda.device(device):
            _call(self._driver.cuInit, 0)
            ordinal = _call(self._driver.cuDeviceGet, torch.cuda.current_device())
            # The primary context is the one that torch uses.
            self._context = _call(self._driver.cuDevicePrimaryCtxRetain, ordinal)
            _call(self._driver.cuCtxSetCurrent, self._context)
            self._module = _call(self._driver.cuModuleLoadData, np.frombuffer(image, np.uint8).ctypes.data)
        self._function = cache(partial(_call, self._driver.cuModuleGetFunction, self._module))

    def launch(self, kernel: str, blocks: int, threads: int, *arguments: Tensor | int | np.ndarray | None) -> None:
        """Queue a kernel on torch's current stream, in blocks of a number of threads, without waiting for it."""
        values = packed(*arguments)
        pointers = np.array([value.ctypes.data for value in values], np.uint64)
        with torch.cuda.device(self._device):
            _call(self._driver.cuCtxSetCurrent, self._context)  # A new thread may have no context yet.
            stream = self._driver.CUstream(torch.cuda.current_stream().cuda_stream)
            size = (blocks, 1, 1, threads, 1, 1)
            _call(
                self._driver.cuLaunchKernel, self._function(kernel.encode()), *size, 0, stream, pointers.ctypes.data, 0
            )


def packed(*arguments: Tensor | int | np.ndarray | None) -> list[np.ndarray]:
    """Return the bytes of kernel arguments: pointers of tensors (null if None or empty), 32-bit integers, structures."""
    values = []
    for argument in arguments:
        if isinstance(argument, Tensor):
            values.append(np.array(argument.data_ptr() if argument.numel() else 0, np.uint64))
        elif isinstance(argument, np.ndarray):
            values.append(argument)
        else:
            values.append(np.array(argument or 0, np.uint64 if argument is None else np.int32))
    return values


@cache
def kernels(device: torch.device) -> Kernels:
    """Return the kernels of a GPU, compiled and loaded at the first call.

    Raises:
        CudaUnavailable: The kernels cannot be compiled or loaded.
    """
    return Kernels(device)


def field(mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None) -> Tensor:
    """Return real and imaginary part of the field, (B, 2, n_elevation, n_azimuth); see `operators.field`."""
    rendered = mean.new_empty(mean.shape[0], 2, *grid.shape)
    _render(mean, cholesky, weight, grid, cutoff, rendered, None)
    return rendered


def magnitude(
    mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None, keep_phase: bool
) -> tuple[Tensor, Tensor | None]:
    """Return |A|, (B, n_elevation, n_azimuth), and with `keep_phase` A / |A|, 0 where A is 0, else None."""
    rendered = mean.new_empty(mean.shape[0], *grid.shape)
    phase = mean.new_empty(mean.shape[0], 2, *grid.shape) if keep_phase else None
    _render(mean, cholesky, weight, grid, cutoff, phase, rendered)
    return rendered, phase


def _render(
    mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None,
    field: Tensor | None, magnitude: Tensor | None,
) -> None:  # fmt: skip
    """Write into `field` and `magnitude`; with both, the field is divided by its magnitude."""
    batch, n = mean.shape[:2]
    if not batch:
        return
    mean, cholesky, weight = _aligned(mean, cholesky, weight)
    common = n, cholesky.dim() == 3, _grid(grid), _cutoff(cutoff)
    across, down = -(-grid.n_azimuth // TILE_COLUMNS), -(-grid.n_elevation // TILE_ROWS)
    words = -(-n // THREADS_PER_WARP)
    reached = torch.empty(batch, across + down, words, dtype=torch.int32, device=mean.device)
    launch = kernels(mean.device).launch
    if n:
        launch("find_reach", batch * -(-words // WARPS_PER_BLOCK), THREADS_PER_BLOCK, mean, cholesky, reached, *common)
    blocks = -(-batch * across * down // WARPS_PER_BLOCK)
    launch("rasterize", blocks, THREADS_PER_BLOCK, mean, cholesky, weight, reached, field, magnitude, batch, *common)


def field_gradients(
    grad: Tensor, mean: Tensor, cholesky: Tensor, weight: Tensor, grid: AngularGrid, cutoff: float | None,
    phase: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Return the gradients of mean, factor and weight for a gradient (B, 2, n_elevation, n_azimuth) of the field.

    With `phase`, the field divided by its magnitude, it is one (B, n_elevation, n_azimuth) of the magnitude.
    """
    grad, mean, cholesky, weight = _aligned(grad, mean, cholesky, weight)
    batch, n = mean.shape[:2]
    d_mean, d_weight, d_cholesky = torch.empty_like(mean), torch.empty_like(weight), cholesky.new_empty(batch, n, 3)
    if mean.numel():
        # Small blocks wait less for each other, large ones read the incoming gradient less often.
        warps = GATHERING_WARPS // 2 if n <= SMALL else GATHERING_WARPS
        per_warp = min(-(-n // warps), THREADS_PER_WARP)
        kernels(mean.device).launch(
            "rasterize_backward", batch * -(-n // (warps * per_warp)), warps * THREADS_PER_WARP,
            grad, phase, mean, cholesky, weight, d_mean, d_cholesky, d_weight,
            n, per_warp, cholesky.dim() == 3, _grid(grid), _cutoff(cutoff),
        )  # fmt: skip
    return d_mean, d_cholesky if cholesky.dim() == 3 else d_cholesky.sum(0), d_weight


def _aligned(*tensors: Tensor) -> list[Tensor]:
    """Return the tensors as the kernels read them: float32, contiguous, aligned to pairs of floats."""
    for tensor in tensors:
        if tensor.dtype != torch.float32 or tensor.device != tensors[0].device:
            raise InputError(f"expected float32 tensors on {tensors[0].device}, got {tensor.dtype} on {tensor.device}")
    contiguous = (tensor.contiguous() for tensor in tensors)
    return [tensor if tensor.data_ptr() % 8 == 0 else tensor.clone() for tensor in contiguous]


def _grid(grid: AngularGrid) -> np.ndarray:
    """Return the structure `Grid` of the kernels."""
    axes = (grid.azimuth_start, grid.azimuth_step), (grid.elevation_start, grid.elevation_step)
    conversion = [value for start, step in axes for value in _axis(start, step)]
    return np.array((conversion, (grid.n_azimuth, grid.n_elevation)), "8f4, 2i4")


def _axis(start: float, step: float) -> tuple[float, float, float, float]:
    """Return the structure `Axis` for pixel = angle * scale - start.

    Each factor is a float32 and its rounding error; the float32 of `start` is a multiple of 1/2.
    """
    scale, pixels = 1 / step, start / step
    halves = round(2 * pixels) / 2
    return scale, scale - float(np.float32(scale)), halves, pixels - halves


def _cutoff(cutoff: float | None) -> np.ndarray:
    """Return the structure `Cutoff`: log2 of the least kernel value, and its distance in standard deviations."""
    log2 = -126.0 if cutoff is None else math.log2(cutoff)  # Smaller float32 numbers are flushed to zero.
    return np.array([log2, math.sqrt(-2 * math.log(2) * log2)], np.float32)
