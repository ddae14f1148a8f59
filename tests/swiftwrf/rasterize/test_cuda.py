"""The CUDA backend: compiled by NVRTC, run on the CPU through a shim and, on a machine with a GPU, on it."""

import ctypes
import math
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest import mock

import pytest
import torch
from hard_cases import (
    GRADIENT_TOLERANCE,
    HARD_CASES,
    VALUE_TOLERANCE,
    Case,
    degrees,
    field_errors,
    magnitude_errors,
    random_scene,
)
from torch._subclasses.fake_tensor import FakeTensorMode

from swiftwrf import AngularGrid, InputError, rasterize
from swiftwrf.contrib.rasterize import cuda
from swiftwrf.rasterize import operators

SHIM = Path(__file__).parents[2] / "cuda_shim"
rasterize_package = sys.modules[rasterize.__module__]
KERNELS = {"find_reach", "rasterize", "rasterize_backward"}


# ---------------------------------------------------------------------------------------------------------- compilation


@pytest.fixture(scope="module")
def architectures():
    try:
        return cuda.architectures()
    except cuda.CudaUnavailable as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("architecture", [75, 80, 86, 89, 90, 100, 120])
def test_compiles_to_machine_code_without_stack_and_within_64_registers(architectures, architecture):
    if architecture not in architectures:
        pytest.skip(f"this NVRTC does not compile for sm_{architecture}")
    source = cuda.SOURCE.read_text()
    image, log = cuda.compile_source(source, f"sm_{architecture}", "--ptxas-options=-v")
    assert image.startswith(b"\x7fELF")
    assert set(re.findall(r"entry function '(\w+)'", log)) == KERNELS
    assert re.findall(r"(\d+) bytes stack frame, (\d+) bytes spill", log) == [("0", "0")] * len(KERNELS)
    assert max(int(n) for n in re.findall(r"Used (\d+) registers", log)) <= 64


@pytest.mark.usefixtures("architectures")
def test_compiles_to_portable_code():
    image, _ = cuda.compile_source(cuda.SOURCE.read_text(), "compute_90")
    assert set(re.findall(r"\.entry (\w+)\(", image.decode())) == KERNELS
    assert image.endswith(b"\0")  # The driver reads PTX up to the null byte.


def test_newer_gpus_get_portable_code_and_older_ones_a_sentence(architectures):
    newest = architectures[-1]
    assert cuda.target(newest) == f"sm_{newest}"
    assert cuda.target(newest + 10) == f"compute_{newest}"
    with pytest.raises(InputError, match=r"compute capability 7\.5 or more, got 6\.1"):
        cuda.target(61)


@pytest.mark.usefixtures("architectures")
def test_a_source_that_does_not_compile_is_refused_with_the_log():
    with pytest.raises(InputError, match=r"cannot compile the rasterizer for sm_90.*: rasterize\.cu\(1\): error"):
        cuda.compile_source("nonsense", "sm_90")


# ------------------------------------------------------------------------------------------------------- unavailability


def test_missing_bindings_are_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "cuda.bindings.nvrtc", None)
    with pytest.raises(InputError, match="needs the package cuda-bindings; install it, or use backend='reference'"):
        cuda.architectures()


@pytest.mark.parametrize(("function", "library"), [("nvrtcVersion", "NVRTC"), ("cuInit", "the NVIDIA driver")])
def test_missing_libraries_are_named(function, library):
    missing = mock.Mock(side_effect=RuntimeError("not found"), __name__=function)
    with pytest.raises(InputError, match=f"needs {library}, which cuda.bindings does not find"):
        cuda._call(missing)


def test_auto_falls_back_to_the_reference_with_one_warning(monkeypatch):
    monkeypatch.setattr(cuda, "kernels", mock.Mock(side_effect=cuda.CudaUnavailable("no driver")))
    rasterize_package._cuda_compiles.cache_clear()
    device = torch.device("cuda")
    with pytest.warns(UserWarning, match="slow backend 'reference': no driver") as warned:
        assert [rasterize_package._available(device) for _ in range(2)] == [False] * 2
    assert len(warned) == 1
    rasterize_package._cuda_compiles.cache_clear()
    monkeypatch.setattr(cuda, "kernels", mock.Mock())
    assert rasterize_package._available(device)
    with FakeTensorMode():
        mean, cholesky = torch.empty(1, 3, 2, device="cuda"), torch.empty(3, 3, device="cuda")
        assert rasterize_package._fast(mean, cholesky, mean, "auto", None)
        assert not rasterize_package._fast(mean.double(), cholesky.double(), mean.double(), "auto", None)
    rasterize_package._cuda_compiles.cache_clear()


# -------------------------------------------------------------------------------------------- the source, run on the CPU


class KernelsOnCpu:
    """Launch like `cuda.Kernels`, on the CPU."""

    def __init__(self, library: Path) -> None:
        self._library = ctypes.CDLL(str(library))

    def launch(self, kernel, blocks, threads, *arguments):
        values = cuda.packed(*arguments)
        pointers = (ctypes.c_void_p * len(values))(*(value.ctypes.data for value in values))
        assert self._library.launch(kernel.encode(), ctypes.c_uint(blocks), threads, pointers) == 0


def build(library, *options):
    """Compile the kernels for the CPU."""
    if shutil.which("g++") is None or sys.platform != "linux":
        pytest.skip("needs g++ on Linux")
    command = ["g++", "-std=c++17", "-ffp-contract=off", "-shared", "-fPIC", f"-I{cuda.SOURCE.parent}"]
    subprocess.run([*command, *options, str(SHIM / "rasterize.cpp"), "-o", str(library)], check=True)


@pytest.fixture(scope="module")
def shim(tmp_path_factory):
    """Let the operators render CPU tensors with the CUDA backend."""
    library = tmp_path_factory.mktemp("shim") / "rasterize.so"
    build(library, "-O2")
    on_cpu, on_gpu = KernelsOnCpu(library), cuda.kernels
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(operators.BACKENDS, "cpu", cuda.__name__)
        patch.setattr(cuda, "kernels", lambda device: on_cpu if device.type == "cpu" else on_gpu(device))
        yield


@pytest.mark.long
@pytest.mark.usefixtures("architectures", "shim")
def test_cuda_bindings_launch_the_kernels_on_a_stand_in_for_the_driver_and_sanitizers_find_nothing(tmp_path):
    """Without the sanitizers if g++ comes without them."""
    names = [["g++", f"-print-file-name=lib{name}.so"] for name in ("asan", "ubsan")]
    runtime = [subprocess.run(name, capture_output=True, text=True, check=True).stdout.strip() for name in names]
    sanitizers = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    if not all(Path(library).is_absolute() for library in runtime):
        sanitizers, runtime = [], []
    build(tmp_path / "libcuda.so.1", "-O1", "-fvisibility=hidden", *sanitizers, str(SHIM / "driver.cpp"))
    environment = os.environ | {
        "LD_LIBRARY_PATH": str(tmp_path),
        "PYTHONPATH": os.pathsep.join(sys.path),
        "LD_PRELOAD": " ".join(runtime),
        "ASAN_OPTIONS": "detect_leaks=0",  # Python's own
    }
    command = [sys.executable, str(SHIM / "launch.py")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-8000:]
    assert done.stdout.startswith("cuModuleGetFunction failed with CUDA_ERROR_NOT_FOUND; use backend='reference'")


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)], ids=["shim", "gpu"])
def device(request):
    """The CPU through the shim, and a GPU."""
    if request.param == "cpu":
        request.getfixturevalue("shim")
    return request.param


@pytest.fixture
def poisoned():
    """Fresh memory holds not-a-number, so that a pixel or gradient that nobody writes shows."""
    torch.use_deterministic_algorithms(True)  # torch then fills what it hands out empty
    yield
    torch.use_deterministic_algorithms(False)


def assert_close(case, cutoff, device="cpu"):
    """A and |A|, in value and gradient, within the table of tolerances."""
    for value, gradient in (
        field_errors(operators.field, case, cutoff, device),
        magnitude_errors(operators.field_magnitude, case, cutoff, device),
    ):
        assert value < VALUE_TOLERANCE[cutoff] * case.slack
        assert gradient < GRADIENT_TOLERANCE[cutoff] * case.slack


def ordinary(inputs, grid):
    """A case of the given inputs."""
    return Case("", *(x.detach() for x in inputs), grid)


@pytest.mark.parametrize("cutoff", [None, 1e-4])
@pytest.mark.parametrize("case", HARD_CASES)
@pytest.mark.usefixtures("poisoned")
def test_small_hard_cases(device, case, cutoff):
    """The shim runs one thread after another, so a crowd is of its first 300 primitives, more than two batches."""
    chosen = HARD_CASES[case]
    if device == "cpu":
        few = {"mean": chosen.mean[:, :300], "cholesky": chosen.cholesky[:300], "weight": chosen.weight[:, :300]}
        chosen = replace(chosen, **few)
    assert_close(chosen, cutoff, device)


# every pair of shape, widths and cutoff, not every triple
@pytest.mark.parametrize(
    ("shape", "n", "per_position", "cutoff"),
    [
        ((7, 12), 33, True, None),
        ((7, 12), 33, False, 1e-4),
        ((16, 16), 50, True, 1e-4),
        ((16, 16), 50, False, None),
        ((17, 33), 100, True, None),
        ((17, 33), 100, False, 1e-4),
        ((30, 120), 40, True, 1e-4),
        ((30, 120), 40, False, None),
    ],
)
@pytest.mark.usefixtures("poisoned")
def test_agrees_with_the_reference(device, shape, n, per_position, cutoff):
    grid = AngularGrid.hemisphere(*shape)
    assert_close(ordinary(random_scene(n, 2, per_position=per_position, grid=grid), grid), cutoff, device)


def many(n, grid, batch=1):
    """Primitives about as wide as their distance from each other."""
    inputs = [x.detach() for x in random_scene(n, batch, grid=grid)]
    width = math.sqrt(math.pi**2 / n) / 2
    inputs[1] = (
        width * torch.tensor([1.0, 0.3, 0.8]) * (1 + torch.rand(n, 3, generator=torch.Generator().manual_seed(3)))
    )
    return inputs


@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize(
    ("device", "shape", "n"),
    [
        ("cpu", (90, 360), 30),
        pytest.param("cuda", (90, 360), 2000, marks=pytest.mark.cuda),
        pytest.param("cuda", (180, 720), 200, marks=pytest.mark.cuda),
    ],
    indirect=["device"],
)
def test_agrees_on_large_grids(device, shape, n):
    grid = AngularGrid.hemisphere(*shape)
    assert_close(ordinary(many(n, grid), grid), None, device)


@pytest.mark.usefixtures("shim", "poisoned")
def test_small_tiles_that_nothing_reaches_are_zero():
    mean, cholesky = degrees((180.0, 45.0)), torch.tensor([[0.05, 0.0, 0.05]])
    rendered = operators.field(mean, cholesky, torch.ones(1, 1, 2), AngularGrid.hemisphere(30, 120), 1e-4)
    assert 0 < torch.count_nonzero(rendered) < 400
    assert rendered.isfinite().all()


@pytest.mark.parametrize(("batch", "n"), [(2, 0), (0, 4), (0, 0)])
@pytest.mark.usefixtures("shim", "poisoned")
def test_small_nothing_to_render(batch, n):
    inputs = [x.requires_grad_() for x in (torch.zeros(batch, n, 2), torch.ones(n, 3), torch.zeros(batch, n, 2))]
    rendered = operators.field(*inputs, AngularGrid.hemisphere(17, 33), 1e-4)
    assert rendered.shape == (batch, 2, 17, 33)
    assert not rendered.any()
    for gradient, x in zip(torch.autograd.grad(rendered.sum(), inputs), inputs, strict=True):
        assert torch.equal(gradient, torch.zeros_like(x))


def test_same_bits_twice_and_whatever_the_batch(device):
    grid = AngularGrid.hemisphere(17, 33)
    inputs = [x.detach().to(device) for x in random_scene(60, 5, per_position=True, grid=grid)]
    cotangent = torch.randn(5, 2, *grid.shape, generator=torch.Generator().manual_seed(1)).to(device)
    whole, gradients = value_and_gradients(inputs, grid, cotangent)
    again, gradients_again = value_and_gradients(inputs, grid, cotangent)
    assert torch.equal(whole, again)
    assert all(torch.equal(a, b) for a, b in zip(gradients, gradients_again, strict=True))
    for i in range(5):
        alone, alone_gradients = value_and_gradients([x[i : i + 1] for x in inputs], grid, cotangent[i : i + 1])
        assert torch.equal(whole[i : i + 1], alone)
        assert all(torch.equal(a[i : i + 1], b) for a, b in zip(gradients, alone_gradients, strict=True))


def value_and_gradients(inputs, grid, cotangent):
    """Return the field of the CUDA backend and its gradients."""
    leaves = [x.detach().requires_grad_() for x in inputs]
    rendered = operators.field(*leaves, grid, 1e-4)
    return rendered.detach(), torch.autograd.grad(rendered, leaves, cotangent)


@pytest.mark.usefixtures("shim", "poisoned")
def test_magnitude_has_no_gradient_where_nothing_is():
    """A lone primitive leaves most pixels at 0."""
    leaves = [
        x.requires_grad_() for x in (degrees((180.0, 45.0)), torch.tensor([[0.05, 0.0, 0.05]]), torch.ones(1, 1, 2))
    ]
    rendered = operators.field_magnitude(*leaves, AngularGrid.hemisphere(30, 120), 1e-4)
    assert bool((rendered == 0).any())
    assert all(gradient.isfinite().all() for gradient in torch.autograd.grad(rendered.sum(), leaves))


@pytest.mark.usefixtures("shim")
def test_takes_strided_and_misaligned_tensors():
    grid = AngularGrid.hemisphere(17, 33)
    mean, cholesky, weight = (x.detach() for x in random_scene(20, 1, grid=grid))
    expected = operators.field(mean.repeat(3, 1, 1), cholesky, weight.repeat(3, 1, 1), grid, 1e-4)
    misaligned = torch.cat([torch.zeros(1), weight.flatten()])[1:].view_as(weight)
    assert misaligned.data_ptr() % 8
    strided = operators.field(mean.expand(3, -1, -1), cholesky, weight.expand(3, -1, -1), grid, 1e-4)
    assert torch.equal(strided, expected)
    assert torch.equal(operators.field(mean, cholesky, misaligned, grid, 1e-4), expected[:1])


@pytest.mark.usefixtures("shim")
def test_operator_refuses_other_dtypes():
    mean, cholesky, weight = (x.detach() for x in random_scene(4, 1))
    with pytest.raises(InputError, match=r"expected float32 tensors on cpu, got torch\.float64"):
        operators.field(mean, cholesky.double(), weight, AngularGrid.hemisphere(17, 33), 1e-4)


@pytest.mark.usefixtures("shim")
def test_a_primitive_that_is_not_a_number_shows():
    mean, cholesky, weight = (x.detach() for x in random_scene(4, 1))
    mean[0, 1, 0] = float("nan")
    assert operators.field(mean, cholesky, weight, AngularGrid.hemisphere(17, 33), 1e-4).isnan().any()


# ------------------------------------------------------------------------------------------------------------ on a GPU


@pytest.mark.cuda
def test_gpu_is_what_auto_renders_with():
    inputs = [x.detach().cuda() for x in random_scene(20, 2)]
    grid = AngularGrid.hemisphere(17, 33)
    assert torch.equal(rasterize(*inputs, grid), rasterize(*inputs, grid, backend="cuda"))
    doubles = [x.double() for x in inputs]
    assert torch.equal(rasterize(*doubles, grid), rasterize(*doubles, grid, backend="reference"))


@pytest.mark.cuda
def test_gpu_follows_the_current_stream():
    grid = AngularGrid.hemisphere(90, 360)
    inputs = [x.cuda() for x in many(1000, grid)]
    expected = operators.field(*inputs, grid, 1e-4)
    other = torch.cuda.Stream()
    other.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(other):
        torch.cuda._sleep(50_000_000)  # cycles: a launch on another stream would overtake the next line
        late = [x * 1 for x in inputs]
        rendered = operators.field(*late, grid, 1e-4)
    other.synchronize()
    assert torch.equal(rendered, expected)


@pytest.mark.cuda
def test_gpu_graph_capture():
    grid = AngularGrid.hemisphere(17, 33)
    leaves = [x.detach().cuda().requires_grad_() for x in random_scene(20, 2, grid=grid)]
    cotangent = torch.ones(2, 2, *grid.shape, device="cuda")

    def step():
        rendered = operators.field(*leaves, grid, 1e-4)
        return rendered, *torch.autograd.grad(rendered, leaves, cotangent)

    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        step()  # builds and loads the kernels
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = step()
    with torch.no_grad():
        leaves[0].add_(0.1)
    graph.replay()
    for got, expected in zip(captured, step(), strict=True):
        assert torch.equal(got, expected)


@pytest.mark.cuda
def test_gpu_every_device():
    if torch.cuda.device_count() < 2:
        pytest.skip("needs two GPUs")
    grid = AngularGrid.hemisphere(17, 33)
    inputs = [x.detach() for x in random_scene(20, 2, grid=grid)]
    rendered = [operators.field(*(x.to(f"cuda:{i}") for x in inputs), grid, 1e-4) for i in (1, 0)]
    assert [d.device.index for d in rendered] == [1, 0]
    torch.testing.assert_close(rendered[0].cpu(), rendered[1].cpu())


@pytest.mark.cuda
def test_gpu_memory_checker_finds_nothing():
    if shutil.which("compute-sanitizer") is None:
        pytest.skip("needs compute-sanitizer, which comes with the CUDA toolkit")
    command = [
        "compute-sanitizer",
        "--error-exitcode=1",
        "--report-api-errors=no",  # cuda.bindings asks an older driver for functions that it lacks
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "no:cacheprovider",
        __file__,
    ]
    selected = ["-k", "test_small_hard_cases and gpu and (seam or pole)"]
    run = subprocess.run([*command, *selected], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-4000:]
