"""Hard cases: every backend within its tolerance, every fit good or refused in a sentence, never not-a-number."""

import math

import pytest
import stability
import torch
from hard_cases import HARD_CASES, random_scene

from swiftwrf import AngularGrid, InputError, rasterize
from swiftwrf.metrics import ssim
from swiftwrf.rasterize.operators import magnitude

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


@pytest.mark.parametrize("name", ["mean", "cholesky", "weight"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_what_is_not_finite_is_refused(name, value, backend):
    case = HARD_CASES["both sides of the seam"]
    inputs = dict(zip(("mean", "cholesky", "weight"), (x.clone() for x in case.inputs), strict=True))
    inputs[name].view(-1)[1] = value
    with pytest.raises(InputError, match=f"{name} contains a value that is not finite"):
        rasterize(**inputs, grid=case.grid, backend=backend)


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
