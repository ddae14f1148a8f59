"""CUDA C++ to running kernels with what comes with torch: its NVRTC compiles, the NVIDIA driver loads and launches.

No CUDA toolkit, no C++ compiler, nothing built at install or import. Compiled images are kept in the user's cache folder
(`$XDG_CACHE_HOME` or `~/.cache`), so that only the first use of a new version, architecture or NVRTC waits (0.3 s).
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import os
import sys
import tempfile
from collections.abc import Iterable, Iterator
from ctypes import byref, c_char_p, c_int, c_size_t, c_uint, c_void_p
from pathlib import Path

import torch

from swiftwrf.errors import InputError
from swiftwrf.runtime.durable import cache_folder

# with subnormals flushed exp2f is one instruction; divisions and roots to 2 units in the last place, without a subroutine
OPTIONS = ("--std=c++17", "--ftz=true", "--prec-div=false", "--prec-sqrt=false")
OLDEST = 75  # compute capability 7.5 (Turing), the oldest that NVRTC 13 compiles for
Argument = c_int | c_void_p | ctypes.Structure  # of a kernel
_WINDOWS = sys.platform == "win32"


class CudaUnavailable(InputError):
    """The CUDA rasterizer cannot be built or run here; one sentence says what is missing."""


class Nvrtc:
    """NVIDIA's runtime compiler; needs neither a GPU nor a driver.

    Raises:
        CudaUnavailable: the library is not there.
    """

    def __init__(self) -> None:
        self._library = _load("NVRTC, which comes with torch for CUDA", _nvrtc_paths())
        self._library.nvrtcGetErrorString.restype = c_char_p
        major, minor = c_int(), c_int()
        self._check(self._library.nvrtcVersion(byref(major), byref(minor)), "nvrtcVersion")
        self.version = f"{major.value}.{minor.value}"

    @property
    def architectures(self) -> list[int]:
        """Compute capabilities, times ten, that it compiles for."""
        count = c_int()
        self._check(self._library.nvrtcGetNumSupportedArchs(byref(count)), "nvrtcGetNumSupportedArchs")
        architectures = (c_int * count.value)()
        self._check(self._library.nvrtcGetSupportedArchs(architectures), "nvrtcGetSupportedArchs")
        return sorted(architectures)

    def target(self, capability: int) -> str:
        """What to compile for on a GPU: its own machine code, or, where it is newer than NVRTC, code that the driver
        translates when it loads it."""
        known = [a for a in self.architectures if OLDEST <= a <= capability]
        if not known:
            raise CudaUnavailable(
                f"the CUDA rasterizer needs a GPU of compute capability {OLDEST / 10} or more, got {capability / 10}; "
                "use maker='reference', or the CPU"
            )
        return f"sm_{capability}" if capability in known else f"compute_{known[-1]}"

    def compile(self, source: str, target: str, *options: str) -> tuple[bytes, str]:
        """The image of a CUDA C++ source for a target such as sm_90, and the compiler's log.

        Raises:
            CudaUnavailable: it does not compile.
        """
        library, program = self._library, c_void_p()
        self._check(
            library.nvrtcCreateProgram(byref(program), source.encode(), b"rasterize.cu", 0, None, None),
            "nvrtcCreateProgram",
        )
        try:
            arguments = [o.encode() for o in (f"--gpu-architecture={target}", *OPTIONS, *options)]
            status = library.nvrtcCompileProgram(program, len(arguments), (c_char_p * len(arguments))(*arguments))
            log = self._read(program, "nvrtcGetProgramLog").rstrip(b"\0").decode(errors="replace")
            if status:
                raise CudaUnavailable(
                    f"NVRTC {self.version} cannot compile the rasterizer for {target}; use maker='reference', or the "
                    f"CPU: {log.strip() or self._library.nvrtcGetErrorString(status).decode()}"
                )
            return self._read(program, "nvrtcGetCUBIN" if target.startswith("sm_") else "nvrtcGetPTX"), log
        finally:
            library.nvrtcDestroyProgram(byref(program))

    def _read(self, program: c_void_p, what: str) -> bytes:
        size = c_size_t()
        self._check(getattr(self._library, f"{what}Size")(program, byref(size)), f"{what}Size")
        text = ctypes.create_string_buffer(size.value)
        self._check(getattr(self._library, what)(program, text), what)
        return text.raw

    def _check(self, status: int, what: str) -> None:
        if status:
            raise CudaUnavailable(f"{what} of NVRTC failed: {self._library.nvrtcGetErrorString(status).decode()}")


class Kernels:
    """The kernels of a source, loaded on one GPU.

    Raises:
        CudaUnavailable: no NVRTC, no driver, a GPU too old, or an image that the driver does not take.
    """

    def __init__(self, source: str, device: torch.device) -> None:
        self._device = device
        self._driver = _load("the NVIDIA driver", ["nvcuda.dll" if _WINDOWS else "libcuda.so.1"])
        self._driver.cuGetErrorString.argtypes = [c_int, ctypes.POINTER(c_char_p)]
        self._functions: dict[str, c_void_p] = {}
        major, minor = torch.cuda.get_device_capability(device)
        image = _image(Nvrtc(), source, 10 * major + minor)
        handle = c_int()
        self._context, self._module = c_void_p(), c_void_p()
        with torch.cuda.device(device):
            ordinal = torch.cuda.current_device()
            self._check(self._driver.cuInit(0), "cuInit")
            self._check(self._driver.cuDeviceGet(byref(handle), ordinal), "cuDeviceGet")
            # the context that torch uses, too
            self._check(self._driver.cuDevicePrimaryCtxRetain(byref(self._context), handle), "cuDevicePrimaryCtxRetain")
            self._check(self._driver.cuCtxSetCurrent(self._context), "cuCtxSetCurrent")
            self._check(self._driver.cuModuleLoadData(byref(self._module), image), "cuModuleLoadData")

    def launch(self, kernel: str, blocks: int, threads: int, *arguments: Argument) -> None:
        """Queues a kernel on torch's current stream of the device; returns before it has run."""
        pointers = (c_void_p * len(arguments))(*(ctypes.addressof(a) for a in arguments))
        with torch.cuda.device(self._device):
            stream = c_void_p(torch.cuda.current_stream().cuda_stream)
            self._check(self._driver.cuCtxSetCurrent(self._context), "cuCtxSetCurrent")  # a thread may have none yet
            status = self._driver.cuLaunchKernel(
                self._function(kernel), c_uint(blocks), 1, 1, c_uint(threads), 1, 1, 0, stream, pointers, None
            )
            self._check(status, f"cuLaunchKernel of {kernel}")

    def _function(self, kernel: str) -> c_void_p:
        if kernel not in self._functions:
            function = c_void_p()
            status = self._driver.cuModuleGetFunction(byref(function), self._module, kernel.encode())
            self._check(status, f"cuModuleGetFunction of {kernel}")
            self._functions[kernel] = function
        return self._functions[kernel]

    def _check(self, status: int, what: str) -> None:
        if status:
            text = c_char_p()
            self._driver.cuGetErrorString(status, byref(text))
            raise CudaUnavailable(f"{what} failed on {self._device}: {(text.value or b'unknown error').decode()}")


def _image(nvrtc: Nvrtc, source: str, capability: int) -> bytes:
    """The compiled source, from the cache where it is there and whole."""
    target = nvrtc.target(capability)
    key = hashlib.sha256("\0".join((source, *OPTIONS)).encode()).hexdigest()[:16]
    path = cache_folder() / f"rasterize-{key}-{target}-nvrtc{nvrtc.version}"
    try:
        digest, image = (content := path.read_bytes())[:32], content[32:]
        if hashlib.sha256(image).digest() == digest:
            return image
    except OSError:
        pass  # not there yet
    image, _ = nvrtc.compile(source, target)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(hashlib.sha256(image).digest() + image)
        os.replace(file.name, path)  # whole or not at all, whoever else compiles it now
    except OSError:
        pass  # a folder that cannot be written costs a compilation next time
    return image


def _nvrtc_paths() -> Iterator[str]:
    """Where NVRTC may be: with torch's wheels, the release that torch was built with first; then on the system's path."""
    release = (torch.version.cuda or "").split(".")[0]
    pattern = "nvrtc64_*_0.dll" if _WINDOWS else "libnvrtc.so.*"
    nvidia = importlib.util.find_spec("nvidia")
    packages = [Path(p) for p in (nvidia and nvidia.submodule_search_locations) or ()]
    found = [str(path) for package in packages for path in sorted(package.glob(f"*/lib/{pattern}"))]
    found += [str(path) for path in sorted((Path(torch.__file__).parent / "lib").glob(pattern))]
    yield from sorted(found, key=lambda path: f".so.{release}" not in path)
    yield from [f"nvrtc64_{release}0_0.dll"] if _WINDOWS else [f"libnvrtc.so.{release}", "libnvrtc.so"]


def _load(what: str, candidates: Iterable[str]) -> ctypes.CDLL:
    for name in candidates:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise CudaUnavailable(f"the CUDA rasterizer needs {what}, and it was not found; use maker='reference', or the CPU")
