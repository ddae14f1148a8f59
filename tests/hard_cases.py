"""Scenes of the rasterizer: random ones, hard cases with the rule that each follows, and tolerances of all backends.

Tolerances are relative to the definition in float64: those of values to the sum of |weight|, those of gradients are relative
L2, and both are multiplied by a case's `slack`. Without a cutoff, float32 rounding determines them. With one, the cutoff
determines those of values.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.models.primitives import MIN_WIDTH_PIXELS
from swiftwrf.rasterize import reference
from swiftwrf.rasterize.operators import magnitude

VALUE_TOLERANCE = {None: 5e-6, 1e-4: 3e-4}
# One of 500 random scenes has more than 1e-5, one that hypothesis found 4e-5: gradients of a narrow primitive cancel. The
# dense float32 definition has 1e-3.
GRADIENT_TOLERANCE = {None: 5e-5, 1e-4: 5e-5}
Inputs = tuple[Tensor, Tensor, Tensor]  # mean, Cholesky factor, weight
Draw = Callable[[Tensor, Tensor, Tensor, AngularGrid, float | None], Tensor]
STEP = math.radians(90 / 16)  # about two pixels of the small grid
GRID = AngularGrid.hemisphere(30, 120)
SMALL = AngularGrid.hemisphere(17, 33)  # no multiple of any tile


def random_scene(
    n: int = 40,
    batch: int = 3,
    seed: int = 0,
    per_position: bool = False,
    dtype: torch.dtype = torch.float32,
    grid: AngularGrid = GRID,
) -> list[Tensor]:
    """Return mean, Cholesky factor and weight of random sheared primitives, which require gradients.

    Widths are from the smallest one to a radian. Some means lie beyond both edges or whole turns away.
    """
    generator = torch.Generator().manual_seed(seed)
    mean = torch.rand(batch, n, 2, generator=generator) * torch.tensor([6 * math.pi, 2.2]) - torch.tensor(
        [2 * math.pi, 0.3]
    )
    shape = (batch, n, 3) if per_position else (n, 3)
    floor = MIN_WIDTH_PIXELS * torch.tensor([grid.azimuth_step, 0.0, grid.elevation_step])
    cholesky = torch.exp(torch.rand(shape, generator=generator) * 4 - 4) + floor
    cholesky[..., 1] *= torch.randn(shape[:-1], generator=generator)
    weight = torch.randn(batch, n, 2, generator=generator)
    return [x.to(dtype).requires_grad_() for x in (mean, cholesky, weight)]


@dataclass(frozen=True)
class Case:
    """One hard case.

    Args:
        rule: what every backend does with it.
        mean: azimuth and elevation, (1, N, 2) [rad].
        cholesky: (N, 3) [rad].
        weight: (1, N, 2).
        grid: to draw on.
        slack: factor of its tolerance, for the reason in `why`.
    """

    rule: str
    mean: Tensor
    cholesky: Tensor
    weight: Tensor
    grid: AngularGrid = SMALL
    slack: float = 1.0
    why: str = ""

    @property
    def inputs(self) -> Inputs:
        """Mean, Cholesky factor, weight."""
        return self.mean, self.cholesky, self.weight


def degrees(*angles: tuple[float, float]) -> Tensor:
    """Means (1, N, 2) of pairs of azimuth and elevation."""
    return torch.deg2rad(torch.tensor([angles], dtype=torch.float64)).float()


def _case(rule: str, mean: Tensor, factor: tuple[float, float, float] = (1.2, 0.7, 1.5), **changes: object) -> Case:
    """Primitives of one factor (in `STEP`) and random weights."""
    weight = torch.randn(mean.shape, generator=torch.Generator().manual_seed(2))
    cholesky = STEP * torch.tensor([factor]).repeat(mean.shape[1], 1)
    return Case(**({"rule": rule, "mean": mean, "cholesky": cholesky, "weight": weight} | changes))  # type: ignore[arg-type]


def _crowd() -> Tensor:
    """5,000 primitives within a tenth of a pixel."""
    return degrees((100.0, 40.0)) + 0.1 * STEP * torch.randn(1, 5000, 2, generator=torch.Generator().manual_seed(2))


def _cancelling(strength: float) -> Case:
    """Pairs of opposite sign, 0.05 pixels apart, that leave a sum of order 1."""
    generator = torch.Generator().manual_seed(2)
    mean = torch.rand(1, 20, 2, generator=generator) * torch.tensor([2 * math.pi, math.pi / 2])
    weight = torch.randn(1, 20, 2, generator=generator)
    shifted = mean + 0.05 * SMALL.elevation_step
    return _case(
        "error grows with the sum of |weight|, not with |A|",
        torch.cat([mean, shifted], dim=1),
        weight=torch.cat([strength * weight, (0.01 - strength) * weight], dim=1),
        slack=10,
        why="the direction of a small difference A is rounded more coarsely than its parts, and the gradient of |A| has it",
    )


TWO = degrees((10.1, 30.2), (200.3, 60.4))
ON_PIXELS = degrees((10.91, 31.77), (207.27, 58.24))  # a hundredth of a pixel off their centres
SHEARED = "v = (dy - l2 u) / l3 magnifies rounding by l2 / l3"
HARD_CASES: dict[str, Case] = {
    "both sides of the seam": _case(
        "azimuth is periodic: distances are wrapped, coordinates never",
        degrees((359.9, 30.0), (-0.1, 60.0), (0.1, 45.0)),
    ),
    "turns away": _case("whole turns change nothing", degrees((3700.0, 30.0), (-7300.0, 45.0))),
    "beyond the poles": _case("elevation ends: nothing folds back at the poles", degrees((10.0, -8.0), (200.0, 97.0))),
    "far beyond the poles": _case("rows are clipped", degrees((10.0, -4e5), (200.0, 3e7), (30.0, 50.0))),
    "wider than the grid": _case("one turn, centred on the mean, is drawn", TWO, (60.0, 10.0, 80.0)),
    "a fiftieth of a pixel": _case(
        "what no pixel centre sees draws nothing; parameters are kept above 0.3 pixels", ON_PIXELS, (0.04, 0.01, 0.04)
    ),
    "narrow and sheared": _case("no determinant is formed", TWO, (0.3, 3.0, 0.3)),
    "correlation 0.9998": _case("no determinant is formed", TWO, (2.0, 50.0, 1.0), slack=50, why=SHEARED),
    "correlation 0.9999995": _case("no determinant is formed", ON_PIXELS, (2.0, 1000.0, 1.0), slack=1000, why=SHEARED),
    "flipped factors": _case("signs of the diagonal mean nothing to the covariance", TWO, (-2.0, 1.0, -1.5)),
    "5,000 primitives on one pixel": _case("no limit a pixel or tile", _crowd(), (0.8, 0.3, 0.6)),
    "pairs that cancel, S = 1": _cancelling(1.0),
    "pairs that cancel, S = 10": _cancelling(10.0),
    "pairs that cancel, S = 100": _cancelling(100.0),
    "pairs that cancel, S = 1000": _cancelling(1000.0),
    "responses of 1e-15": _case("magnitudes from 1e-18 to 1e18", TWO, weight=1e-15 * torch.ones(1, 2, 2)),
    "responses of 1e15": _case("magnitudes from 1e-18 to 1e18", TWO, weight=1e15 * torch.ones(1, 2, 2)),
}


def field_errors(draw: Draw, case: Case, cutoff: float | None, device: str = "cpu") -> tuple[float, float]:
    """Errors of A from a backend: value and the worst of the gradients; see `_compare`."""
    exact_inputs, inputs = _leaves(case, device)
    exact = reference.field(*exact_inputs, case.grid, cutoff)
    return _compare(exact, draw(*inputs, case.grid, cutoff), exact_inputs, inputs)


def magnitude_errors(draw: Draw, case: Case, cutoff: float | None, device: str = "cpu") -> tuple[float, float]:
    """Return the errors of |A|: value and the worst of the gradients.

    Near |A| = 0 the direction of its gradient depends on the rounding of A, so the cotangent is small there.
    """
    exact_inputs, inputs = _leaves(case, device)
    exact = magnitude(reference.field(*exact_inputs, case.grid, cutoff))
    fade = (exact / exact.mean().clamp_min(1e-300)).clamp(max=1).detach()
    return _compare(exact, draw(*inputs, case.grid, cutoff), exact_inputs, inputs, fade)


def _leaves(case: Case, device: str) -> tuple[Inputs, Inputs]:
    """The inputs in float64, and as they are, both awaiting gradients."""
    mean, cholesky, weight = (x.detach().double().requires_grad_() for x in case.inputs)
    own = (x.detach().to(device).requires_grad_() for x in case.inputs)
    return (mean, cholesky, weight), (next(own), next(own), next(own))


def _compare(
    exact: Tensor, drawn: Tensor, exact_inputs: Inputs, inputs: Inputs, fade: Tensor | float = 1.0
) -> tuple[float, float]:
    """Return the largest value error relative to sum |weight|, and the largest relative L2 error of the gradients.

    Gradients are by mean, Cholesky factor and weight for a random cotangent. Errors are infinite for values that are not
    finite.
    """
    cotangent = fade * torch.randn(exact.shape, generator=torch.Generator().manual_seed(1)).double()
    wanted = torch.autograd.grad(exact, exact_inputs, cotangent)
    got = torch.autograd.grad(drawn, inputs, cotangent.to(drawn))
    scale = exact_inputs[2].detach().norm(dim=-1).sum(dim=-1).max().clamp_min(1e-300)
    value = (drawn.detach().cpu() - exact.detach()).abs().max() / scale
    gradients = [(g.cpu() - w).norm() / w.norm().clamp_min(1e-300) for g, w in zip(got, wanted, strict=True)]
    return float(value.nan_to_num(math.inf)), float(torch.stack(gradients).nan_to_num(math.inf).max())
