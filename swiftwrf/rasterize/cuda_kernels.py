"""Compile the kernels of `rasterize.cu` with NVRTC and launch them, both through the package `cuda.bindings`.

Neither a CUDA toolkit nor a C++ compiler is needed. Compilation takes about 0.2 s at the first use in a process.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from swiftwrf.errors import InputError

SOURCE = Path(__file__).with_name("rasterize.cu")
# With subnormals flushed to zero exp2f is one instruction. Divisions and roots are accurate to two units in the last place.
OPTIONS = ("--std=c++17", "--ftz=true", "--prec-div=false", "--prec-sqrt=false")
MIN_CAPABILITY = 75  # Ten times compute capability 7.5 (Turing), the oldest that NVRTC 13 compiles for.
REMEDY = "use backend='reference' or tensors on the CPU"


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
    """Return the compilation target for a GPU: machine code, or portable PTX if the GPU is newer than NVRTC.

    Args:
        capability: Ten times the compute capability of the GPU.

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
    """Compile CUDA C++. Needs neither a GPU nor a driver.

    Args:
        source: CUDA C++ source.
        target: Architecture such as "sm_90" for a CUBIN or "compute_90" for PTX.
        options: Further options of NVRTC.

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

    Args:
        device: GPU to load the kernels on.

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
        """Queue a kernel on torch's current stream of the device, without waiting for it.

        Args:
            kernel: Name of the kernel.
            blocks: Number of blocks.
            threads: Number of threads of a block.
            arguments: Arguments of the kernel; see `packed`.
        """
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
