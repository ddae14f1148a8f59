"""Positions of receivers that a survey does not state: a posterior for each of them, from its RSSI.

The RSSI y of a receiver at q in n location bins x is a path-loss model and a directivity, whose coefficients b are normal,
plus a Gaussian process of the position, plus noise:

    y = level + slope log10 |x - q| + F(x, q) b + e,    b ~ N(0, I),    e ~ N(0, field_db^2 K + noise_db^2 / count)

The coefficients are integrated out, and the posterior is proportional to p(y | q)^w. Walls shift the values of whole regions
in ways that no Gaussian process describes, so the weight w of the likelihood is below 1. Receivers of known position
determine it if there are enough of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import torch
from pandas import DataFrame
from torch import Tensor

from swiftwrf.data.coordinates import GeodeticOrigin
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import MIN_TRAINING
from swiftwrf.errors import InputError, listed
from swiftwrf.gp import Kernel
from swiftwrf.locate.posterior import Posterior, normalised, pooled_weights
from swiftwrf.locate.region import Cells, refined
from swiftwrf.metrics import LEVEL
from swiftwrf.plotting import Displayed
from swiftwrf.positions import inside
from swiftwrf.rssi.config import RssiConfig
from swiftwrf.rssi.offsets import FloorAttenuation, estimate_floor_attenuation
from swiftwrf.rssi.path_loss import PathLoss, fit_path_losses, log_distance
from swiftwrf.rssi.posterior import regressors
from swiftwrf.rssi.training import Bins, choose_residual_kernels, prior_std
from swiftwrf.runtime.threads import parallel_map
from swiftwrf.runtime.validation import checked

MIN_PLACES = 6  # of a receiver's rows, below which its position is not estimated
MIN_KNOWN = 8  # receivers of known position that determine the weight of the likelihood
N_SHARED = 24  # most often detected receivers, which determine what all receivers share
N_STRONGEST = 50  # strongest rows that are bins of their own
N_BINS = 60  # location bins of all other rows
N_REFINEMENTS = 3  # halvings of the edges of the most probable cells
N_SPLIT = 100  # cells of a receiver that a refinement splits
BATCH_CANDIDATES = 500  # candidates whose regressors are in memory together
HEIGHTS_M = (0.0, 1.0, 2.0)  # candidate heights of a receiver above the transmitter
CAPPED_COUNT = 4.0  # measurements that a bin counts as at most: rows at one place have like errors
DEFAULT_WEIGHT = 0.6  # of the likelihood; see `locate_receivers`
MODE_WIDTH = 0.025  # width of the smoothing that the estimate maximises, relative to the extent of the rows


@dataclass(frozen=True, eq=False)
class ReceiverPositions(Displayed):
    """Estimated positions of R receivers.

    Args:
        names: Names of the receivers.
        position: Estimates, the modes of the smoothed posteriors, float64 (R, 3) [m].
        radius_m: Radius in plan around the estimate that contains the receiver with 80 % probability, (R,) [m].
        outside: Probability that the receiver is outside of what was walked, (R,).
        strongest: Positions of the strongest rows, a baseline, (R, 3) [m].
        centroid: Mean positions of the rows weighted by their power, a baseline, (R, 3) [m].
        posterior: Posteriors in plan, a row for each receiver; `posterior.plot(0)` draws the first one.
        weight: Weight of the likelihood in the posterior.
        origin: Latitude and longitude of x = y = 0, if they are known.
        plan_scale: Pixels in a metre, if the positions were pixels of a floor plan.

    Example:
        >>> import swiftwrf
        >>> floor = swiftwrf.rssi_room(n=100).derived(receiver_position=torch.full((12, 3), torch.nan))
        >>> locate_receivers(floor.columns([0])).to_frame().columns[:5].tolist()
        ['receiver', 'x', 'y', 'z', 'radius_80_m']
    """

    names: tuple[str, ...]
    position: Tensor
    radius_m: Tensor
    outside: Tensor
    strongest: Tensor
    centroid: Tensor
    posterior: Posterior
    weight: float
    origin: GeodeticOrigin | None = field(default=None, repr=False)
    plan_scale: float | None = field(default=None, repr=False)

    @property
    def is_outside(self) -> Tensor:
        """True for receivers that are more probably outside of what was walked than inside, (R,)."""
        return self.outside > 0.5

    def to_frame(self) -> DataFrame:
        """Return a table that can be given back as `receivers.csv` beside the survey, a row for each receiver.

        Positions have the coordinates of the survey: metres, pixels of its floor plan, or degrees.
        """
        xyz = self.position.numpy()
        if self.origin is not None:
            degrees = self.origin.to_degrees(xyz[:, :2]).round(8)
            place = {"latitude": degrees[:, 0], "longitude": degrees[:, 1], "altitude": xyz[:, 2].round(2)}
        else:
            scale = (1.0, 1.0) if self.plan_scale is None else (self.plan_scale, -self.plan_scale)
            place = {
                "x": (scale[0] * xyz[:, 0]).round(3),
                "y": (scale[1] * xyz[:, 1]).round(3),
                "z": xyz[:, 2].round(2),
            }
        return DataFrame({"receiver": self.names, **place}).assign(
            radius_80_m=self.radius_m.numpy().round(2),
            outside=self.outside.numpy().round(2),
            strongest_x_m=self.strongest[:, 0].numpy().round(2),
            strongest_y_m=self.strongest[:, 1].numpy().round(2),
        )

    def __repr__(self) -> str:
        return (
            f"<ReceiverPositions of {listed(self.names)}:\n median 80 % radius {float(self.radius_m.median()):.2f} m>"
        )

    def _facts(self) -> dict[str, str]:
        radius = f"{float(self.radius_m.median()):.2f} m"
        return {
            "receivers": listed(self.names),
            "median 80 % radius": radius,
            "outside": str(int(self.is_outside.sum())),
        }


@checked
def locate_receivers(
    data: Rssi, *, n_cells: int = 1200, margin: float = 0.35, weight: float | None = None
) -> ReceiverPositions:
    """Estimate the positions of the receivers of unknown position, each from its own RSSI.

    Receivers that were detected in fewer than 10 rows or at fewer than 6 places are left out. In a building with floors
    a receiver is on the floor of its strongest mean RSSI.

    Args:
        data: Measured rows. Known positions of receivers determine path loss, and the weight if there are 8 or more.
        n_cells: Number of candidate positions, before the most probable ones are refined.
        margin: Width of the band around the rows where receivers may be, relative to the extent of the rows.
        weight: Weight of the likelihood, above 0. Defaults to that of the known receivers, or to 0.6, which maximises the
            density at the true positions of 58 receivers of 8 surveys (`benchmarks/survey.py receivers`).

    Raises:
        InputError: Receivers that move, or no receiver of unknown position with enough rows.

    Example:
        >>> import swiftwrf
        >>> floor = swiftwrf.rssi_room(n=200)
        >>> hidden = floor.derived(receiver_position=torch.full((12, 3), torch.nan)).columns([0, 1])
        >>> found = locate_receivers(hidden)
        >>> bool((found.position - floor.receiver_position[:2])[:, :2].norm(dim=1).median() < 3.0)
        True
    """
    if data.receiver_moves:
        raise InputError(f"the receivers of {data.name} move and have no position to estimate; give fixed ones")
    usable = _usable(data)
    asked = (usable & ~data.receiver_located).nonzero()[:, 0].tolist()
    if not asked:
        raise InputError(
            f"no receiver of {data.name} has an unknown position and {MIN_TRAINING} rows at {MIN_PLACES} places or more; "
            "measure at more places, or leave the positions of receivers out"
        )
    attenuation = None if data.floors is None else estimate_floor_attenuation(data)
    rows = data if attenuation is None else attenuation.removed(data)
    search = _Search(rows, attenuation, n_cells, margin)
    model = search.shared(usable)
    if weight is None:
        known = (usable & data.receiver_located).nonzero()[:, 0].tolist()
        weight = search.weight(known, model) if len(known) >= MIN_KNOWN else DEFAULT_WEIGHT
    cells, value = search.candidates(asked, model, weight)
    posterior, position, radius = search.estimates(cells, value, weight)
    known_rows = data.transmitter_position.numpy()
    walked = torch.stack([torch.from_numpy(inside(at.numpy(), known_rows)) for at in posterior.position])
    chosen = data.columns(asked)
    return ReceiverPositions(
        names=chosen.receiver_names,
        position=position,
        radius_m=radius,
        outside=(posterior.weight * ~walked).sum(dim=1),
        strongest=strongest_rows(chosen),
        centroid=weighted_centroids(chosen),
        posterior=posterior,
        weight=weight,
        origin=data.origin,
        plan_scale=data.plan_scale,
    )


def strongest_rows(data: Rssi) -> Tensor:
    """Return the position of the strongest row of each receiver, (R, 3) [m]."""
    return data.transmitter_position[data.rssi_dbm.nan_to_num(-torch.inf).argmax(dim=0)]


def weighted_centroids(data: Rssi) -> Tensor:
    """Return the mean position of the rows of each receiver, weighted by their power [mW], (R, 3) [m]."""
    power = 10 ** (data.rssi_dbm.nan_to_num(-torch.inf) / 10)
    return (power / power.sum(dim=0)).T @ data.transmitter_position


def _usable(data: Rssi) -> Tensor:
    """Return the receivers with enough rows and places, bool (R,)."""
    places = [len(data.transmitter_position[seen].unique(dim=0)) for seen in data.detected.T]
    return (data.detected.sum(dim=0) >= MIN_TRAINING) & (torch.tensor(places) >= MIN_PLACES)


@dataclass(frozen=True, eq=False)
class SharedPathLoss:
    """Path loss that is learnt from all receivers together.

    Args:
        each: Model of each receiver, (R,).
        level: Level of all receivers [dBm].
        slope: Slope of all receivers [dB a decade].
        root: A factor of the covariance of a receiver's level and slope about these, root @ root^T, (2, 2).
        kernel: Kernel of the residuals.
        field_db: Standard deviation of their field [dB].
        noise_db: Standard deviation of the noise [dB].
        common_db: Standard deviation of the part of the field that all receivers have at a position, e.g. behind a wall
            [dB].
    """

    each: PathLoss
    level: float
    slope: float
    root: Tensor
    kernel: Kernel
    field_db: float
    noise_db: float
    common_db: float

    @classmethod
    def fit(
        cls,
        data: Rssi,
        receiver: Tensor,
        spread_db: float = 3.0,
        noises: tuple[float, ...] = (0.3, 1.0, 2.0, 3.0),
    ) -> SharedPathLoss:
        """Fit the shared path loss and the kernel with receivers at given positions (R, 3) [m].

        Args:
            data: Rows.
            receiver: Positions of the receivers, of which most are estimates.
            spread_db: Prior standard deviation of `fit_path_losses`. With 6 dB the mean error of 72 positions on six
                simulated floors is 0.92 m for 0.86 m. 80 % intervals of the coverage of a further receiver on 18 floors hold
                85 % with 2 dB and 88 % with 3 dB. Those of receivers that are left out of measured sets hold 76 % with 2 dB.
            noises: Compared variances of a measurement relative to that of the field. Smaller ones explain errors of the
                positions by the field: with 0.03 and 0.1, too, the weight of the likelihood is 0.45 for 0.67, and 80 %
                regions hold 56 of 58 receivers for 53 (`benchmarks/survey.py receivers`).
        """
        bins = Bins.of(data, RssiConfig(max_locations=300))
        at = receiver - bins.centre
        losses = fit_path_losses(bins.position, at, bins.rssi, "unknown", spread_db=spread_db)
        residual = bins.rssi - losses.each(log_distance(bins.position, at))
        ((kernel, _),) = choose_residual_kernels(bins, residual[..., None], noises)
        field_db, noise_db = (float(std.median()) for std in prior_std(losses.variance, kernel, bins.noise_scale))
        level, slope = float(losses.shared.level[0]), float(losses.shared.slope[0])
        seen = residual.isfinite().double()
        value, both = residual.nan_to_num(), seen.T @ seen
        products, pairs = value.T @ value, ~torch.eye(len(receiver), dtype=torch.bool)
        common = float(products[pairs].sum() / both[pairs].sum().clamp_min(1)) if len(receiver) > 1 else 0.0
        common_db = math.sqrt(min(max(common, 0.0), 0.9 * field_db**2))
        return cls(losses.each, level, slope, losses.root[0], kernel, field_db, noise_db, common_db)

    def predict(self, log_distance: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation [dB] of a measurement of a further receiver at log10 distances (n,) [m]."""
        feature = torch.stack([torch.ones_like(log_distance), log_distance], dim=1) @ self.root
        variance = feature.square().sum(dim=1) + self.field_db**2 + self.noise_db**2
        return self.level + self.slope * log_distance, variance.sqrt()


@dataclass(frozen=True, eq=False)
class _Evidence:
    """Rows of one receiver: positions (n, 3) [m], RSSI (n,) [dBm] and number of measurements (n,) of bins."""

    position: Tensor
    rssi: Tensor
    count: Tensor

    @classmethod
    def of(cls, data: Rssi, column: int) -> _Evidence:
        """Average the rows of a receiver by location bin; its strongest rows are bins of their own."""
        rows = data.columns([column]).subset(data.detected[:, column])
        order = rows.rssi_dbm[:, 0].argsort(descending=True, stable=True)
        parts = [Bins.of(rows.subset(order[:N_STRONGEST].sort().values), RssiConfig(max_locations=N_STRONGEST))]
        if len(others := order[N_STRONGEST:].sort().values):
            parts.append(Bins.of(rows.subset(others), RssiConfig(max_locations=N_BINS)))
        fields = ([bins.position + bins.centre, bins.rssi[:, 0], bins.count[:, 0]] for bins in parts)
        return cls(*(torch.cat(values) for values in zip(*fields, strict=True)))

    def log_likelihood(self, candidate: Tensor, model: SharedPathLoss, directivity_std_db: float = 1.0) -> Tensor:
        """Return log p(y | q) up to a constant at candidates q (m, 3) [m], (m,).

        E is the covariance of e. With A = I + F^T E^-1 F and u = F^T E^-1 y it is

            -(y^T E^-1 y - u^T A^-1 u + log |A|) / 2.

        Args:
            candidate: Candidate positions.
            model: What all receivers share.
            directivity_std_db: Prior standard deviation of each harmonic of the directivity [dB]. 0, 1, 1.5 and 2 were
                compared by the density at the true positions of 58 receivers.
        """
        centre = self.position.mean(dim=0)
        at, n = self.position - centre, len(self.position)
        noise = model.noise_db**2 / self.count.clamp_max(CAPPED_COUNT)
        factor = torch.linalg.cholesky(model.field_db**2 * model.kernel(at, at) + noise.diag())
        parts = []
        for part in (candidate - centre).split(BATCH_CANDIDATES):
            feature = regressors(at, part, model.root[None], directivity_std_db)  # (m, n, k)
            value = self.rssi - model.level - model.slope * log_distance(at, part).T
            columns = torch.cat([feature, value[..., None]], dim=2)
            flat = columns.transpose(0, 1).reshape(n, -1)
            white = torch.linalg.solve_triangular(factor, flat, upper=False).reshape(n, len(part), -1).transpose(0, 1)
            gram = white.mT @ white
            k = feature.shape[2]
            root = torch.linalg.cholesky(gram[:, :k, :k] + torch.eye(k, dtype=torch.float64))
            explained = torch.linalg.solve_triangular(root, gram[:, :k, k:], upper=False)[..., 0].square().sum(dim=1)
            log_determinant = 2 * root.diagonal(dim1=1, dim2=2).log().sum(dim=1)
            parts.append(-0.5 * (gram[:, k, k] - explained + log_determinant))
        return torch.cat(parts)


class _Search:
    """Candidate positions of the receivers of a survey, and their likelihoods."""

    def __init__(self, data: Rssi, attenuation: FloorAttenuation | None, n_cells: int, margin: float) -> None:
        self.data, self.attenuation = data, attenuation
        position = data.transmitter_position
        low, high = position.amin(dim=0)[:2], position.amax(dim=0)[:2]
        self.extent_m = float((high - low).max()) or 1.0
        low, high = low - margin * self.extent_m, high + margin * self.extent_m
        spacing = math.sqrt(float((high - low).prod()) * len(HEIGHTS_M) / n_cells)
        counts = ((high - low) / spacing).round().clamp_min(1)
        edge = torch.zeros(2, 3, dtype=torch.float64)
        edge[:, :2] = ((high - low) / counts).diag()
        lines = [
            start + side * (torch.arange(int(count), dtype=torch.float64) + 0.5)
            for start, side, count in zip(low, edge.diagonal(), counts, strict=True)
        ]
        cells = torch.cartesian_prod(*lines, torch.tensor(HEIGHTS_M, dtype=torch.float64))
        equal = torch.full((len(cells),), -math.log(len(cells)), dtype=torch.float64)
        self.cells = Cells(cells, equal, edge, torch.zeros_like(equal))

    def on_floor(self, columns: Sequence[int]) -> Cells:
        """Return the cells of each receiver of these columns, at heights above the transmitters on its floor."""
        heights = self.data.transmitter_position[:, 2].median().expand(len(columns))
        if self.attenuation is not None:
            at, floors = self.data.transmitter_position, self.attenuation.floors
            floor = floors.number(at)
            rows = [at[floor == number, 2] for number in range(len(floors.names))]
            of_floor = [float(z.median()) if len(z) else low for z, low in zip(rows, floors.height_m, strict=True)]
            heights = torch.tensor([of_floor[self.attenuation.receiver_floor[column]] for column in columns]).double()
        position = self.cells.position.repeat(len(columns), 1, 1)
        position[..., 2] += heights[:, None]
        shape = position.shape[:2]
        return Cells(position, self.cells.log_volume.expand(shape), self.cells.edge, self.cells.level.expand(shape))

    def shared(self, usable: Tensor, rounds: int = 3) -> SharedPathLoss:
        """Return what all receivers share. Unknown positions are the strongest rows first, then the most likely cells."""
        often = self.data.detected.sum(dim=0).where(usable, -1).argsort(descending=True, stable=True)
        columns = often[: min(N_SHARED, int(usable.sum()))].sort().values.tolist()
        data = self.data.columns(columns)
        known, evidence = data.receiver_located[:, None], [_Evidence.of(self.data, column) for column in columns]
        receiver, cells = data.receiver_position.where(known, strongest_rows(data)), self.on_floor(columns)
        model = SharedPathLoss.fit(data, receiver)
        for _ in range(rounds - 1 if not bool(known.all()) else 0):
            best = [value.argmax() for value in self.values(evidence, cells.position, model)]
            estimate = torch.stack([at[i] for at, i in zip(cells.position, best, strict=True)])
            model = SharedPathLoss.fit(data, data.receiver_position.where(known, estimate))
        return model

    def values(self, evidence: Sequence[_Evidence], position: Tensor, model: SharedPathLoss) -> Tensor:
        """Return the log-likelihoods (R, m) at candidates (R, m, 3) [m] of each receiver."""
        work = zip(evidence, position, strict=True)
        return torch.stack(parallel_map(lambda one: one[0].log_likelihood(one[1], model), work))

    def candidates(self, columns: Sequence[int], model: SharedPathLoss, weight: float) -> tuple[Cells, Tensor]:
        """Return the refined cells (R, m) of the receivers of these columns, and their log-likelihoods (R, m)."""
        evidence, cells = [_Evidence.of(self.data, column) for column in columns], self.on_floor(columns)
        value = self.values(evidence, cells.position, model)[None]
        evaluate = partial(self.values, evidence, model=model)
        for _ in range(N_REFINEMENTS):
            mass = weight * value[0] + cells.log_volume
            cells, value = refined(cells, mass, value, lambda position: evaluate(position)[None], N_SPLIT)
        return cells, value[0]

    def weight(self, columns: Sequence[int], model: SharedPathLoss) -> float:
        """Return the weight of the likelihood with the greatest posterior density at receivers of known position."""
        cells, value = self.candidates(columns, model, DEFAULT_WEIGHT)
        truth = self.data.receiver_position[list(columns)][:, None]
        at_truth = self.values([_Evidence.of(self.data, column) for column in columns], truth, model)
        return float(pooled_weights(at_truth.T, value[None], cells.log_volume)[0].clamp(0.1, 1.0))

    def estimates(self, cells: Cells, value: Tensor, weight: float) -> tuple[Posterior, Tensor, Tensor]:
        """Return posteriors in plan, modes (R, 3) [m] and radii of 80 % regions around them (R,) [m]."""
        log_weight = normalised(weight * value + cells.log_volume)
        flat = cells.position * cells.position.new_tensor([1.0, 1.0, 0.0])
        resolution_m = cells.edge_m / 2**N_REFINEMENTS
        posterior, width = Posterior(flat, log_weight, resolution_m), MODE_WIDTH * self.extent_m
        modes = []
        for at, mass, height in zip(flat, posterior.weight, cells.position[..., 2], strict=True):
            likely = mass > 1e-9 * mass.max()  # all others together do not move the mode
            near = torch.exp(-torch.cdist(at[likely], at[likely]).square() / (2 * width**2)) * mass[likely]
            best = int(near.sum(dim=1).argmax())
            modes.append(torch.stack([*at[likely][best, :2], (near[best] @ height[likely]) / near[best].sum()]))
        position = torch.stack(modes)
        away = (flat[..., :2] - position[:, None, :2]).norm(dim=2)
        order = away.argsort(dim=1)
        held = posterior.weight.gather(1, order).cumsum(dim=1)
        first = (held < LEVEL).sum(dim=1, keepdim=True).clamp_max(away.shape[1] - 1)
        return posterior, position, away.gather(1, order).gather(1, first)[:, 0] + resolution_m / 4
