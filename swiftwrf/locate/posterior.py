"""Posteriors over positions on weighted candidates, alone and along a walk, and the calibrated pool behind them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Self

import numpy as np
import torch
from annotated_types import Ge, Gt, Le, Lt
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from swiftwrf.data.coordinates import Floors
from swiftwrf.data.splits import places
from swiftwrf.errors import InputError
from swiftwrf.metrics import LEVEL, interval_factor
from swiftwrf.plotting import MARK, Axes, Displayed, corners_of, plan
from swiftwrf.positions import nearest
from swiftwrf.runtime.validation import checked

PLAN_PIXELS = 80  # of a posterior in plan, along its longer side
CHUNK = 2**22  # pairs of candidates whose distances are computed together
MAX_KEPT_PAIRS = 4096**2  # pairs of shared candidates whose distances are kept from step to step
MAX_PAIRS = 20_000**2  # pairs of candidates of two consecutive observations
PoolWeights = Annotated[Tensor, "float64 k", Ge(0), Le(1e3)]
Inflation = Annotated[float, Ge(0), Lt(math.inf)]


@dataclass(frozen=True, eq=False)
class PlanMap:
    """Values on a grid in plan.

    Args:
        x: Centres of the columns, ascending, (W,) [m].
        y: Centres of the rows, ascending, (H,) [m].
        values: Values (H, W), nan where there are none.

    Example:
        >>> PlanMap(np.array([0.0, 1.0]), np.array([0.0]), np.array([[3.0, 4.0]])).at(0.8, 0.1)
        4.0
    """

    x: NDArray[np.floating]
    y: NDArray[np.floating]
    values: NDArray[np.floating]

    @property
    def corners(self) -> tuple[float, float, float, float]:
        """Edges x0, x1, y0, y1 of all cells [m]. A single row is as high as a column is wide."""
        return corners_of(self.x, self.y)

    def at(self, x: float, y: float) -> float:
        """Return the value of the cell at a position [m], nan outside of the grid."""
        x0, x1, y0, y1 = self.corners
        if not (x0 <= x <= x1 and y0 <= y <= y1):
            return math.nan
        return float(self.values[np.abs(self.y - y).argmin(), np.abs(self.x - x).argmin()])


@dataclass(frozen=True, eq=False)
class Posterior(Displayed):
    """Posterior over the position of the moving end for each of n observations.

    Args:
        position: Candidate positions, float64 (n, m, 3) [m], or (1, m, 3) if all observations share them.
        log_weight: Logarithms of their posterior masses, which sum to 1, float64 (n, m).
        resolution_m: Edge of the largest cell around a candidate [m].
        inflation: Factor of credible radii that held-out positions call for.
        mode_width_m: Least distance of two modes [m].
        floors: Floors that the candidates are on. None if there is one only.

    Example:
        >>> at = torch.tensor([[[0.0, 0, 0], [1.0, 0, 0]]], dtype=torch.float64)
        >>> posterior = Posterior(at, torch.tensor([[0.25, 0.75]], dtype=torch.float64).log(), 0.1)
        >>> posterior.mean.tolist()
        [[0.75, 0.0, 0.0]]
    """

    position: Tensor
    log_weight: Tensor
    resolution_m: float = 0.0
    inflation: float = 1.0
    mode_width_m: float = 0.0
    floors: Floors | None = None

    def __repr__(self) -> str:
        head = f"<Posterior of {len(self)} observations on {self.log_weight.shape[1]} candidates,"
        return f"{head}\n median 80 % credible radius {self._median_radius}>"

    def _facts(self) -> dict[str, str]:
        return {
            "observations": str(len(self)),
            "candidates": str(self.log_weight.shape[1]),
            "median 80 % credible radius": self._median_radius,
        }

    @property
    def _median_radius(self) -> str:
        return f"{float(self.credible_radius().quantile(0.5)):.2f} m"

    def in_plan(self, row: int = 0, region: Tensor | None = None) -> PlanMap:
        """Return the mass of an observation summed over height and square pixels, relative to the largest sum.

        A pixel without a candidate has the value of the nearest pixel with one, and nan if that is farther away than the
        resolution of the candidates.

        Args:
            row: Number of the observation.
            region: Positions whose extent the map has, (n, 3) [m]. A pixel without a candidate then has the value 0.
                Defaults to the candidates.

        Example:
            >>> at = torch.tensor([[[0.0, 0, 0], [0.0, 0, 1], [1.0, 0, 0]]], dtype=torch.float64)
            >>> weight = torch.tensor([[0.25, 0.25, 0.5]], dtype=torch.float64)
            >>> Posterior(at, weight.log(), 0.1).in_plan().values[0, [0, -1]].tolist()
            [1.0, 1.0]
        """
        at = self.position[row if len(self.position) > 1 else 0, :, :2]
        spread = at if region is None else region[:, :2]
        low, extent = spread.amin(dim=0), spread.amax(dim=0) - spread.amin(dim=0)
        pixel = float(extent.max()) / PLAN_PIXELS or 1.0
        width, height = (round(side / pixel) + 1 for side in extent.tolist())
        column, line = ((at - low) / pixel).round().long().unbind(dim=1)
        column, line = column.clamp(0, width - 1), line.clamp(0, height - 1)
        filled, owner = (line * width + column).unique(return_inverse=True)
        mass = torch.zeros(len(filled), dtype=torch.float64).index_add_(0, owner, self.weight[row])
        every = torch.arange(height * width)
        pixels = torch.stack([every % width, every // width, torch.zeros(len(every))], dim=1).double()
        away, number = nearest(pixels, pixels[filled], 1)
        values = (mass / mass.max())[number[:, 0]]
        if region is None:
            values[away[:, 0] * pixel > max(self.resolution_m, pixel)] = torch.nan
        else:
            values[away[:, 0] > 0] = 0
        x, y = (float(start) + pixel * np.arange(size) for start, size in zip(low, (width, height), strict=True))
        return PlanMap(x, y, values.reshape(height, width).numpy())

    def plot(self, row: int = 0, ax: Axes | None = None) -> Axes:
        """Draw the mass of the candidates, the median and the 80 % credible circle of an observation, seen from above.

        Args:
            row: Number of the observation.
            ax: Axes to draw into. Defaults to those of a new figure.

        Example:
            >>> at = torch.tensor([[[0.0, 0, 0], [1.0, 0, 0]]], dtype=torch.float64)
            >>> Posterior(at, torch.tensor([[0.25, 0.75]], dtype=torch.float64).log(), 0.1).plot().get_xlabel()
            'x [m]'
        """
        position = self.position.expand(len(self), -1, -1)
        one = replace(self, position=position[[row]], log_weight=self.log_weight[[row]])
        order = one.log_weight[0].argsort()  # the largest mass on top
        ax = plan(one.position[0, order], one.weight[0, order], "posterior mass", ax)
        angle = torch.linspace(0, math.tau, 100)
        (x, y, _), radius = one.median[0].tolist(), float(one.credible_radius())
        ax.plot(x, y, "+", color=MARK, markersize=10, label="median")
        ax.plot(x + radius * angle.cos().numpy(), y + radius * angle.sin().numpy(), color=MARK, label="80 % circle")
        ax.legend()
        return ax

    def __len__(self) -> int:
        return len(self.log_weight)

    @classmethod
    def cat(cls, parts: Sequence[Self]) -> Self:
        """Return the posteriors of several groups of observations, on equally many candidates each, as one."""
        first = parts[0]
        is_shared = all(len(part.position) == 1 and part.position.equal(first.position) for part in parts)
        position = [part.position.expand(len(part), -1, -1) for part in parts]
        return replace(
            first,
            position=first.position if is_shared else torch.cat(position),
            log_weight=torch.cat([part.log_weight for part in parts]),
        )

    @property
    def weight(self) -> Tensor:
        """Posterior masses (n, m), which sum to 1."""
        return self.log_weight.exp()

    @property
    def mean(self) -> Tensor:
        """Posterior mean, which minimises the expected squared error, (n, 3) [m]."""
        return torch.einsum("nm,nmk->nk", self.weight, self.position.expand(len(self), -1, -1))

    @property
    def most_likely(self) -> Tensor:
        """Candidate of the largest mass, (n, 3) [m]."""
        at = self.position.expand(len(self), -1, -1)
        return at[torch.arange(len(self)), self.log_weight.argmax(dim=1)]

    @cached_property
    def median(self) -> Tensor:
        """Geometric median, which minimises the expected distance, (n, 3) [m] (E. Weiszfeld, Tohoku Math. J. 43, 1937).

        With floors it is that of the candidates on the most probable floor.
        """
        weight = self.weight
        if self.floors is not None:
            weight = weight * (self._floor_number == self.floor_probability.argmax(dim=1, keepdim=True))
            weight = weight / weight.sum(dim=1, keepdim=True)
        return _geometric_median(self.position, weight, self.resolution_m)

    @property
    def _floor_number(self) -> Tensor:
        """Number of each candidate's floor, as `position`: (n, m) or (1, m)."""
        if self.floors is None:
            return torch.zeros(self.position.shape[:2], dtype=torch.int64)
        return self.floors.number(self.position.reshape(-1, 3)).reshape(self.position.shape[:2])

    @property
    def floor_probability(self) -> Tensor:
        """Posterior mass of each floor, (n, F), F = 1 without floors.

        Example:
            >>> at = torch.tensor([[[0.0, 0, 0], [0.0, 0, 3]]], dtype=torch.float64)
            >>> weight = torch.tensor([[0.25, 0.75]], dtype=torch.float64)
            >>> Posterior(at, weight.log(), floors=Floors(("ground", "first"), (0.0, 3.0))).floor_probability.tolist()
            [[0.25, 0.75]]
        """
        count = 1 if self.floors is None else len(self.floors.names)
        mass = torch.zeros(len(self), count, dtype=self.log_weight.dtype)
        return mass.scatter_add(1, self._floor_number.expand(len(self), -1), self.weight)

    @property
    def std(self) -> Tensor:
        """Posterior standard deviation along each axis, the resolution of the candidates included, (n, 3) [m]."""
        away = self.position - self.mean[:, None]
        variance: Tensor = torch.einsum("nm,nmi->ni", self.weight, away.square()) + self.resolution_m**2 / 12
        return variance.sqrt()

    @checked
    def credible_radius(self, level: Annotated[float, Gt(0), Lt(1)] = LEVEL) -> Tensor:
        """Return the radius [m] around the median within which the position lies with probability `level`, (n,).

        Raises:
            InputError: A level outside (0, 1).
        """
        return self.credible_radii([level])[:, 0]

    def credible_radii(self, levels: Sequence[float]) -> Tensor:
        """Return the radii of `credible_radius` for k levels together, (n, k).

        Example:
            >>> at = torch.tensor([[[0.0, 0, 0], [1.0, 0, 0]]], dtype=torch.float64)
            >>> posterior = Posterior(at, torch.tensor([[0.75, 0.25]], dtype=torch.float64).log(), 0.1)
            >>> posterior.credible_radii([0.5, 0.9]).round(decimals=3).tolist()
            [[0.033, 1.017]]
        """
        radii = self._radii(_distances(self.position, self.median), levels)
        return self.inflation * (radii + self.resolution_m / 4)

    def direction(self, vectors: Tensor) -> Tensor:
        """Return the unit vector of the smallest expected angular error, (n, 3).

        Args:
            vectors: Unit vector towards each candidate, as `position`: (n, m, 3) or (1, m, 3).
        """
        median = _geometric_median(vectors, self.weight, 1e-4)
        unit: Tensor = median / median.norm(dim=1, keepdim=True).clamp_min(1e-12)
        return unit

    @property
    def ambiguous(self) -> Tensor:
        """True where a tenth of the mass lies away from the most likely candidate, beyond the width of its mode, (n,).

        The width is five times the radius that contains 30 % of the mass, four to six standard deviations of a single mode,
        and at least `mode_width_m`.
        """
        away = _distances(self.position, self.most_likely)
        width = (5 * self._radii(away, [0.3])[:, 0] + self.resolution_m).clamp_min(self.mode_width_m)
        second: Tensor = (self.weight * (away > width[:, None])).sum(dim=1) > 0.1
        return second

    def _radii(self, away: Tensor, levels: Sequence[float]) -> Tensor:
        """Return the radii that contain k fractions of the mass, (n, k), given the distances (n, m) of the candidates."""
        away, order = away.sort(dim=1)
        mass = self.weight.gather(1, order).cumsum(dim=1)
        first = torch.searchsorted(mass, torch.tensor(levels, dtype=mass.dtype).expand(len(mass), -1).contiguous())
        return away.gather(1, first.clamp(max=away.shape[1] - 1))


def _distances(point: Tensor, centre: Tensor) -> Tensor:
    """Return the distances (n, m) of points (n, m, k), or (1, m, k) that all rows share, from centres (n, k)."""
    exact = "donot_use_mm_for_euclid_dist"
    if len(point) == 1:
        return torch.cdist(centre, point[0], compute_mode=exact)
    return torch.cdist(centre[:, None], point, compute_mode=exact)[:, 0]


def _geometric_median(point: Tensor, weight: Tensor, smallest: float) -> Tensor:
    """Return the geometric median (n, k) of points (n, m, k), or (1, m, k), with weights (n, m) that sum to 1."""

    def weighted(weight: Tensor) -> Tensor:
        return weight @ point[0] if len(point) == 1 else (weight[:, None] @ point)[:, 0]

    median = weighted(weight)
    for _ in range(30):
        pull = weight / _distances(point, median).clamp_min_(max(smallest / 4, 1e-9))
        median = weighted(pull) / pull.sum(dim=1, keepdim=True)
    return median


def normalised(log_mass: Tensor) -> Tensor:
    """Return logarithms of masses (n, m) shifted so that each row sums to mass 1.

    Raises:
        InputError: A row without a finite mass: likelihoods overflow.
    """
    total = log_mass.logsumexp(dim=1, keepdim=True)
    if not bool(total.isfinite().all()):
        raise InputError("no candidate position has a finite likelihood; the locator overflows, so fit it again")
    return log_mass - total


def pooled_weights(at_truth: Tensor, at_candidates: Tensor, log_volume: Tensor, *, ridge: float = 1e-3) -> Tensor:
    """Return the weights of a log-linear pool that maximise the posterior density at held-out true positions.

        log p(x | y) = sum_k w_k l_k(x, y) - log sum_j V_j exp(sum_k w_k l_k(x_j, y)),    w_k >= 0

    The objective is concave in w (T. Heskes, "Selecting weighting factors in logarithmic opinion pools", 1998). One weight
    below 1 tempers a likelihood that is too certain. The true position is one more candidate, with the smallest mass:
    where a search misses it, the density would otherwise rise with the weights without limit.

    Args:
        at_truth: Log-likelihoods at the true positions, (k, n).
        at_candidates: Log-likelihoods at the candidates of each observation, (k, n, m).
        log_volume: Logarithms of the candidates' prior masses, (n, m).
        ridge: Factor of the squared weights in the objective. It bounds weights that the data do not determine. Not studied.

    Returns:
        Weights, float64 (k,).
    """
    smallest = log_volume.masked_fill(log_volume.isinf(), torch.inf).amin(dim=1, keepdim=True)
    volume = torch.cat([log_volume, smallest], dim=1).double()
    values = torch.cat([at_candidates, at_truth[..., None]], dim=2)
    # relative to the best candidate: constants of each observation cancel
    top = values.amax(dim=2)
    truth, candidates = (at_truth - top).double(), (values - top[..., None]).double()

    def loss(values: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        weight = torch.from_numpy(values)
        log_mass = torch.einsum("k,knm->nm", weight, candidates) + volume
        log_total = log_mass.logsumexp(dim=1, keepdim=True)
        expected = torch.einsum("nm,knm->kn", (log_mass - log_total).exp(), candidates)
        density = torch.einsum("k,kn->n", weight, truth) - log_total[:, 0]
        gradient = (truth - expected).mean(dim=1) - 2 * ridge * weight
        return float(ridge * weight.square().sum() - density.mean()), -gradient.numpy()

    first = np.full(len(at_truth), 0.3 / len(at_truth))  # a concave objective has one optimum, wherever a search starts
    optimum = minimize(loss, first, jac=True, method="L-BFGS-B", bounds=[(0, None)] * len(first))
    return torch.from_numpy(optimum.x)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Observations of a held-out fold at n known positions, and their log-likelihoods by the other folds.

    Args:
        truth: True positions, float64 (n, 3) [m].
        at_truth: Log-likelihoods at the true positions, (k, n).
        position: Candidate positions, float64 (n, m, 3) [m], or (1, m, 3) if all observations share them.
        at_candidates: Log-likelihoods at the candidates, float64 (k, n, m).
        log_volume: Logarithms of the candidates' prior masses, (n, m).
    """

    truth: Tensor
    at_truth: Tensor
    position: Tensor
    at_candidates: Tensor
    log_volume: Tensor


def calibrated_pool(
    held_out: Sequence[HeldOut], resolution_m: float, floors: Floors | None = None
) -> tuple[Tensor, float, Tensor]:
    """Return the weights (k,) of a log-linear pool, the factor of its credible radii, and held-out errors (n,) [m].

    The likelihoods may be wrong in ways that no weight corrects, so errors calibrate the radii; see `interval_factor`.
    Weights fit the positions that choose them better than new ones, so the radii of each fold are those of a pool whose
    weights the other folds choose.

    Args:
        held_out: Folds.
        resolution_m: Edge of the largest cell around a candidate [m].
        floors: Floors that the candidates are on.
    """

    def weights(parts: Sequence[HeldOut]) -> Tensor:
        names = (("at_truth", 1), ("at_candidates", 1), ("log_volume", 0))
        return pooled_weights(*(torch.cat([getattr(part, name) for part in parts], dim=dim) for name, dim in names))

    held_out = [part for part in held_out if len(part.truth)]
    score, errors = [], []
    for part in held_out:
        weight = weights([other for other in held_out if other is not part] or held_out)
        log_mass = torch.einsum("k,knm->nm", weight, part.at_candidates) + part.log_volume
        posterior = Posterior(part.position, normalised(log_mass), resolution_m, floors=floors)
        errors.append((posterior.median - part.truth).norm(dim=1))
        score.append(errors[-1] / posterior.credible_radius(LEVEL).clamp_min(1e-9))
    place = places(torch.cat([part.truth for part in held_out]))
    return weights(held_out), interval_factor(torch.cat(score), place), torch.cat(errors)


def smoothed(posterior: Posterior, time: Tensor | None, speed_m_s: float, *, jump: float = 1e-3) -> Posterior:
    """Return the posterior of each observation given all observations of a walk.

    The motion prior is a random walk: the displacement between consecutive observations is Gaussian along each axis, with
    standard deviation `speed_m_s` times the time between them, and uniform with the probability `jump`. The candidates'
    resolution adds to the variance. The forward-backward recursion is exact on the candidates (L. Rabiner, Proc. IEEE 77,
    1989). A single observation keeps its posterior.

    Args:
        posterior: Posteriors of n independent observations in the order of the walk, on m candidates each.
        time: Time of each observation, which does not decrease, (n,) [s]. None stands for one observation a second.
        speed_m_s: Typical speed, above 0 [m/s].
        jump: Prior probability, for each step, of a displacement that does not depend on the distance. Not studied.

    Raises:
        InputError: A speed or times that are not as above, or more than 20,000 candidates.

    Example:
        >>> at = torch.tensor([[[0.0, 0, 0], [1.0, 0, 0], [9.0, 0, 0]]], dtype=torch.float64)
        >>> weight = torch.tensor([[0.98, 0.01, 0.01], [0.01, 0.49, 0.5]], dtype=torch.float64)
        >>> smoothed(Posterior(at, weight.log()), None, 1.0).most_likely[:, 0].tolist()
        [0.0, 1.0]
    """
    if not (math.isfinite(speed_m_s) and speed_m_s > 0):
        raise InputError(f"a speed is a number above 0 [m/s], got {speed_m_s}")
    n, m = posterior.log_weight.shape
    if m * m > MAX_PAIRS:
        raise InputError(f"a walk is smoothed on at most {math.isqrt(MAX_PAIRS)} candidate positions, got {m}")
    time = torch.arange(n).double() if time is None else torch.as_tensor(time, dtype=torch.float64)
    if time.shape != (n,) or not bool(time.isfinite().all()):
        raise InputError(f"expected {n} finite times [s], one for each observation, got shape {tuple(time.shape)}")
    if len(back := (time.diff() < 0).nonzero()[:, 0]):
        raise InputError(f"observations of a walk must be in the order of time; number {int(back[0]) + 2} is earlier")
    std = (speed_m_s * time.diff()).square().add(posterior.resolution_m**2 / 6).sqrt().clamp_min(1e-6).tolist()
    # the error of the distances is that of float32 relative to the region, not to the origin of the coordinates
    position = (posterior.position - posterior.position.reshape(-1, 3).mean(dim=0)).float().expand(n, -1, -1)
    alone = posterior.log_weight
    # distances between candidates that all observations share are computed once
    shared = _square(position[0], position[0]) if len(posterior.position) == 1 and m * m <= MAX_KEPT_PAIRS else None

    def step(to: Tensor, start: Tensor, std: float, log_mass: Tensor) -> Tensor:
        """Return the log-density at candidates `to` (m, 3) after a step from masses (m,) at `start` (m, 3)."""
        mass = (log_mass - log_mass.max()).exp()
        moved, total = torch.empty(m), 0.0
        for rows in torch.arange(m).split(max(1, CHUNK // m)):
            square = _square(to[rows], start) if shared is None else shared[rows]
            density = (square * (-0.5 / std**2)).exp_()
            moved[rows] = density @ mass.float()
            total += float(density.sum(dtype=torch.float64))
        floor = jump * max(total / m**2, 1e-30) * mass.sum()
        return ((1 - jump) * moved.double() + floor).log()

    before, after = torch.zeros_like(alone), torch.zeros_like(alone)
    for i in range(1, n):
        before[i] = step(position[i], position[i - 1], std[i - 1], alone[i - 1] + before[i - 1])
    for i in range(n - 2, -1, -1):
        after[i] = step(position[i], position[i + 1], std[i], alone[i + 1] + after[i + 1])
    # the inflation belongs to posteriors of single observations
    return replace(posterior, log_weight=normalised(alone + before + after), inflation=1.0)


def _square(to: Tensor, start: Tensor) -> Tensor:
    """Return the squared distances between candidates (k, 3) and (m, 3), float32 (k, m) [m^2]."""
    return torch.cdist(to, start, compute_mode="donot_use_mm_for_euclid_dist").square_()
