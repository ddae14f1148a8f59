"""The CPU backend against the reference, also in hard cases; refused arguments; behaviour without numba; gradients."""

import math
import os
import subprocess
import sys

import numba
import pytest
import stability
import torch
from hard_cases import GRADIENT_TOLERANCE, GRID, HARD_CASES, VALUE_TOLERANCE, Case, field_errors, random_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from swiftwrf import AngularGrid, rasterize
from swiftwrf.metrics import ssim
from swiftwrf.rasterize.operators import magnitude

WITH_TESTS = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}  # where other processes find the random scenes


def against_reference(inputs, grid, cutoff):
    """Return the value error and the largest gradient error of the CPU backend."""

    def render(mean, cholesky, weight, grid, cutoff):
        return rasterize(mean, cholesky, weight, grid, "cpu", cutoff)

    return field_errors(render, Case("", *(x.detach() for x in inputs), grid), cutoff)


@pytest.mark.parametrize("cutoff", [None, 1e-4])
@pytest.mark.parametrize("per_position", [False, True])
@settings(max_examples=8, deadline=None)
@given(
    st.integers(0, 10_000), st.sampled_from([(7, 12), (30, 120), (16, 16)]), st.integers(0, 60), st.sampled_from([1, 3])
)
def test_cpu_agrees_with_the_reference_on_any_scene_and_grid(cutoff, per_position, seed, shape, n, batch):
    grid = AngularGrid.hemisphere(*shape)
    scene = random_scene(n, batch, seed, per_position, grid=grid)
    value, gradient = against_reference(scene, grid, cutoff)
    assert value < VALUE_TOLERANCE[cutoff]
    assert gradient < GRADIENT_TOLERANCE[cutoff]


def test_torch_keeps_its_threads():
    """Numba sets the number of OpenMP threads, which torch shares. It follows torch as far as it has threads."""
    before = torch.get_num_threads()
    try:
        for number in (numba.config.NUMBA_NUM_THREADS + 1, 1):
            torch.set_num_threads(number)
            rasterize(*random_scene(batch=3), GRID, "cpu").sum().backward()
            assert torch.get_num_threads() == number
            assert numba.get_num_threads() == min(number, numba.config.NUMBA_NUM_THREADS)
    finally:
        torch.set_num_threads(before)


def test_one_primitive_is_the_gaussian_of_the_formula():
    mean = torch.tensor([[[math.radians(90), math.radians(45)]]])
    cholesky = torch.tensor([[0.3, 0.1, 0.2]])
    rendered = rasterize(mean, cholesky, torch.tensor([[[2.0, -1.0]]]), GRID, cutoff=None)
    factor = torch.tensor([[0.3, 0.0], [0.1, 0.2]], dtype=torch.float64)
    offset = torch.stack(
        torch.broadcast_tensors(GRID.azimuth[None, :] - math.radians(90), GRID.elevation[:, None] - math.radians(45)),
        dim=-1,
    )
    kernel = torch.exp(-0.5 * torch.einsum("hwi,ij,hwj->hw", offset, torch.linalg.inv(factor @ factor.T), offset))
    torch.testing.assert_close(rendered[0, 0].double(), 2 * kernel, atol=1e-6, rtol=0)
    torch.testing.assert_close(rendered[0, 1].double(), -kernel, atol=1e-6, rtol=0)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_azimuth_is_periodic(backend):
    mean, cholesky, weight = (x.detach() for x in random_scene())
    turned = mean + torch.tensor([GRID.azimuth_step * 7, 0.0])
    a = rasterize(mean, cholesky, weight, GRID, backend, cutoff=None)
    b = rasterize(turned, cholesky, weight, GRID, backend, cutoff=None)
    torch.testing.assert_close(a.roll(7, dims=-1), b, atol=2e-4, rtol=0)


def test_same_bits_twice_and_whatever_the_batch():
    mean, cholesky, weight = (x.detach() for x in random_scene(batch=5))
    whole = rasterize(mean, cholesky, weight, GRID, "cpu")
    assert torch.equal(whole, rasterize(mean, cholesky, weight, GRID, "cpu"))
    for i in range(5):
        assert torch.equal(whole[i], rasterize(mean[i], cholesky, weight[i], GRID, "cpu"))


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize(("batch", "n"), [(2, 0), (0, 4)])
def test_nothing_to_render(backend, batch, n):
    mean, cholesky, weight = torch.zeros(batch, n, 2), torch.ones(n, 3), torch.zeros(batch, n, 2)
    rendered = rasterize(mean, cholesky, weight, GRID, backend)
    assert rendered.shape == (batch, 2, *GRID.shape)
    assert not rendered.any()


def test_without_numba_the_reference_renders_and_default_fits_need_none():
    code = """
import sys
sys.modules["numba"] = None
import warnings, torch, swiftwrf
from swiftwrf.models.swiftwrf_paper import SwiftWRFPaper
from swiftwrf.runtime.threads import set_threads
from hard_cases import GRID, random_scene

set_threads(1)
inputs = [x.detach() for x in random_scene()]
with warnings.catch_warnings(record=True) as caught:
    rendered = swiftwrf.rasterize(*inputs, GRID)
print(caught[0].message)
assert torch.equal(rendered, swiftwrf.rasterize(*inputs, GRID, "reference"))
room = swiftwrf.simulated_room(n=20, grid=swiftwrf.AngularGrid.hemisphere(8, 32))
swiftwrf.SwiftWRF(n_primitives=8).fit(room).predict(room.position)
for use in (
    lambda: swiftwrf.rasterize(*inputs, GRID, "cpu"),
    lambda: SwiftWRFPaper(steps=1).fit(room),
):
    try:
        use()
    except swiftwrf.InputError as error:
        print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], env=WITH_TESTS, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == [
        "rendering with the slow backend 'reference'; the fast one needs numba: pip install 'swiftwrf-tasks[paper]'",
        *["backend 'cpu' needs the package numba; pip install 'swiftwrf-tasks[paper]', or use backend='reference'"] * 2,
    ], done.stderr


def test_magnitude_has_no_gradient_at_zero():
    field = torch.zeros(2, 3, 4, dtype=torch.float64, requires_grad=True)
    magnitude(field).sum().backward()
    assert torch.equal(field.grad, torch.zeros_like(field))


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU's rasterizer speaks to torch's compiler")
def test_preparing_compiles_once_and_leaves_threads_and_torchs_compiler_alone():
    """Numba starts its threads once a process, as many as the processor has. Importing the compiler of torch takes a third
    of the start of a command. Measured times do not include a compilation.
    """
    code = """
import sys, torch
from swiftwrf.contrib.rasterize import cpu
from swiftwrf.rasterize import prepare, rasterize
from hard_cases import GRID, random_scene

prepare("cpu")
print(torch.get_num_threads(), "torch._dynamo" in sys.modules, len(cpu.render.signatures))
with torch.no_grad():
    for per_position in (True, False):
        mean, cholesky, weight = random_scene(per_position=per_position)
        rasterize(mean[:1].expand_as(mean), cholesky, weight, GRID, cutoff=None)
print(len(cpu.render.signatures))
"""
    environment = WITH_TESTS | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True, check=True)
    assert done.stdout.split() == ["1", "False", "1", "1"]


# hard cases: every backend within its tolerance, every fit good or refused in a sentence, never not-a-number


REFUSED = {
    "a pixel that is not a number": "spectrum of training spectrum 3 is not finite; mend or leave it out",
    "learning rate thirty times too large": "try a learning rate below 0.3",
}
SMALL = 24  # primitives of a fit


@pytest.mark.parametrize("cutoff", [None, 1e-4])
@pytest.mark.parametrize("case", HARD_CASES)
def test_cpu_backend_stays_within_its_tolerance(case, cutoff):
    found = stability.render_case(case, "cpu", cutoff, torch.device("cpu"))
    assert found["value"] < found["value_tolerance"]
    assert found["gradient"] < found["gradient_tolerance"]
    assert found["magnitude_gradient"] < found["gradient_tolerance"]


def test_float32_reference_is_finite_in_every_case():
    """It rounds angles in float32, more coarsely than the fast backends. It is the definition in float64."""
    for name in HARD_CASES:
        found = stability.render_case(name, "reference", None, torch.device("cpu"))
        assert found["value"] < 1e-3
        assert math.isfinite(found["gradient"])


@pytest.mark.parametrize("case", [name for name in stability.FITS if name not in REFUSED])
def test_fit_ends_well(case):
    """At least as good as the mean spectrum, where that is not perfect; else nearly perfect."""
    found = stability.fit_case(case, 300, SMALL)
    assert found["refusal"] is None
    assert found["psnr_db"] > min(found["mean_psnr_db"] - 0.5, 30)


@pytest.mark.parametrize("case", REFUSED)
def test_fit_is_refused_in_a_sentence(case):
    found = stability.fit_case(case, 0, SMALL)
    assert REFUSED[case] in found["refusal"]


def test_precision_table_orders_as_it_must():
    rows = {row["what"]: row["error"] for row in stability.precision(torch.device("cpu"))}
    assert rows["float32, no cutoff"] < 1e-5 < rows["float32, cutoff 0.001"] < rows["float32, cutoff 0.01"]
    assert rows["weights in float16"] < rows["weights in bfloat16"] < rows["means in float16"]


# ---------------------------------------------------------------------------------------------- gradients, in float64


def double(*shape, seed=0):
    """Random numbers that await gradients."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_()


def test_gradcheck_of_the_reference():
    inputs = random_scene(n=3, batch=2, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda *x: rasterize(*x, AngularGrid.hemisphere(7, 12), "reference", None), inputs)


def test_gradcheck_of_the_magnitude():
    assert torch.autograd.gradcheck(magnitude, double(2, 2, 3, 4))


def test_gradcheck_of_ssim():
    assert torch.autograd.gradcheck(ssim, (double(8, 9), double(8, 9, seed=1)))
