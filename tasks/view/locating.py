"""Posterior over the position of an observation, and the expected position error over the floor, for the page."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from swiftwrf import Rssi
from swiftwrf.locate import Posterior, RssiLocator
from swiftwrf.locate.posterior import PlanMap
from swiftwrf.locate.rssi import BATCH_ROWS
from swiftwrf.positions import nearest

LEVELS = (0.5, 0.8)  # probabilities of the credible regions that are shown
N_POSITIONS = 300  # of the map of expected errors
N_DRAWS = 16  # simulated rows at each of them


@dataclass(frozen=True, eq=False)
class Located:
    """Posterior over the position of one observation."""

    density: PlanMap  # posterior mass in plan, relative to the largest
    median: NDArray[np.floating]  # geometric median [m], (3,)
    radius: tuple[float, ...]  # radii [m] of the credible regions of `LEVELS` around the median
    truth: NDArray[np.floating]  # measured position [m], (3,)
    ambiguous: bool  # true where a second position is likely

    @classmethod
    def of(cls, posterior: Posterior, truth: Tensor) -> Located:
        """Return what the page shows of the posterior of one observation, measured at `truth` (3,) [m]."""
        radius = tuple(float(posterior.credible_radius(level)) for level in LEVELS)
        return cls(posterior.in_plan(), posterior.median[0].numpy(), radius, truth.numpy(), bool(posterior.ambiguous))

    def describe(self) -> str:
        """Describe the posterior in a few sentences."""
        x, y, z = self.median.tolist()
        regions = ", ".join(f"{level:.0%} within {r:.2f} m" for level, r in zip(LEVELS, self.radius, strict=True))
        return (
            f"median at {x:.2f}, {y:.2f}, {z:.2f} m, {regions}. The measured position is {self.error_m:.2f} m away from the "
            f"median.{' A second position is likely.' if self.ambiguous else ''}"
        )

    @property
    def error_m(self) -> float:
        """Distance between median and measured position [m]."""
        return float(np.linalg.norm(self.median - self.truth))


class RssiLocating:
    """A locator, the rows that it detects and whether it was fitted to each of them, and the expected error over the floor.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.rssi_room(n=60).split()
        >>> locator = RssiLocator(n_cells=200).fit(train)
        >>> locating = RssiLocating(locator, test, torch.zeros(len(test), dtype=torch.bool))
        >>> locating.located(0).median.shape
        (3,)
    """

    def __init__(self, locator: RssiLocator, rows: Rssi, in_training: Tensor) -> None:
        detected = rows.detected.any(dim=1)
        self.locator, self.rows = locator, rows.subset(detected)
        self.in_training: NDArray[np.bool_] = in_training[detected].numpy()
        self.located = lru_cache(maxsize=1)(self._located)
        """Return the posterior of a row, counted from 0 in `rows`. The last one is cached."""

    @classmethod
    def of_training(cls, locator: RssiLocator) -> RssiLocating:
        """Return a locator with its training rows, if the measurements are not known."""
        known = locator.likelihoods.fingerprints.fingerprints
        rows = Rssi(
            known.rssi.double(),
            known.position,
            receiver_position=locator.model.receiver_position,
            receiver_names=locator.receiver_names,
        )
        return cls(locator, rows, torch.ones(len(rows), dtype=torch.bool))

    @property
    def first(self) -> int:
        """First row that is not in the training set, or 0."""
        return int(self.in_training.argmin())

    def numbered(self, number: float) -> int:
        """Return the row whose number in the data is nearest."""
        return int((self.rows.index - number).abs().argmin())

    def nearest(self, x: float, y: float) -> int:
        """Return the row that was measured nearest to a position in plan [m]."""
        return int((self.rows.transmitter_position[:, :2] - torch.tensor([x, y])).norm(dim=1).argmin())

    def _located(self, row: int) -> Located:
        posterior = self.locator.locate(self.rows.rssi_dbm[row : row + 1])
        return Located.of(posterior, self.rows.transmitter_position[row])

    def describe(self, row: int) -> str:
        """Describe the posterior of a row in a few sentences."""
        part = "training" if self.in_training[row] else "test"
        return f"Posterior of {part} row {int(self.rows.index[row])}: {self.located(row).describe()}"

    @property
    def summary(self) -> str:
        """Describe the expected error in a few sentences."""
        values = self.expected_error.values
        inside = values[np.isfinite(values)]
        return (
            f"Expected error of the posterior median: {inside.mean():.1f} m on average, 90 % below "
            f"{np.quantile(inside, 0.9):.1f} m, from {N_DRAWS} simulated rows at each of {len(inside)} positions."
        )

    @cached_property
    def expected_error(self) -> PlanMap:
        """Expected distance [m] between the posterior median and the true position, where rows were measured.

        Rows are simulated at each position of a coarse grid, at the height of the nearest known position, and located.
        """
        x, y, position, inside = _coarse_grid(self.locator)
        generator = torch.Generator().manual_seed(self.locator.config.seed)
        rssi = self.locator.sample(position[inside], N_DRAWS, generator)
        median = torch.cat([self.locator.locate(some).median for some in rssi.flatten(0, 1).split(BATCH_ROWS)])
        error = (median.reshape(*rssi.shape[:2], 3) - position[inside]).norm(dim=2)
        values = torch.full((len(position),), torch.nan, dtype=torch.float64)
        values[inside] = error.mean(dim=0)
        return PlanMap(x.numpy(), y.numpy(), values.reshape(len(y), len(x)).numpy())


def _coarse_grid(locator: RssiLocator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return x (W,), y (H,), positions (H W, 3) [m], and which of them, about `N_POSITIONS`, lie near known ones."""
    region, cells = locator.region, locator.cells.position
    low, high = cells[:, :2].amin(dim=0), cells[:, :2].amax(dim=0)
    extent = high - low
    near = float(region.is_near(cells).double().mean())
    spacing = max(float((extent.prod() * near / N_POSITIONS).sqrt()), float(extent.max()) / N_POSITIONS) or 1.0
    x, y = (
        torch.linspace(float(a), float(b), max(1, round(float(b - a) / spacing)) + 1, dtype=torch.float64)
        if b - a > spacing / 2
        else (a + b)[None] / 2
        for a, b in zip(low, high, strict=True)
    )
    plan = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)
    flat = region.known * torch.tensor([1.0, 1.0, 0.0])
    _, row = nearest(torch.nn.functional.pad(plan, (0, 1)), flat, 1)
    position = torch.cat([plan, region.known[row[:, 0], 2:]], dim=1)
    return x, y, position, region.is_near(position)
