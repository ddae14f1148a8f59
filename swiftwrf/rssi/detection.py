"""Empty cells: the curve of detection, and received power given that a packet was, or was not, detected.

    p(detected | y) = (1 - missed_r) Phi((y - limit_r) / width)

y is the received power of a packet, limit_r the limit of receiver r, width that of all receivers, and missed_r the fraction
of packets that receiver r misses whatever their power. An empty cell is then an upper limit that may be wrong (censored
regression with misclassification: J. Tobin, Econometrica 26, 1958; J. A. Hausman et al., Journal of Econometrics 87, 1998).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from swiftwrf.errors import listed
from swiftwrf.gp import GaussianProcess, Kernel, leave_folds_out, subsample
from swiftwrf.positions import Neighbours
from swiftwrf.runtime.validation import PositiveFloat

MISSES = torch.tensor([1e-3, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3], dtype=torch.float64)  # compared fractions of misses
Cells = tuple[Tensor, Tensor, float]  # values [dB], their receivers, and the number of cells that each stands for


@dataclass(frozen=True, eq=False)
class Detection:
    """The curve of detection of R receivers.

    Args:
        limit: Received power at which each receiver detects half of the packets, float64 (R,) [dBm].
        width: Standard deviation of the limit over packets [dB].
        missed: Fraction of packets of any power that each receiver misses, float64 (R,).
        is_limit: Whether an empty cell is an upper limit for its receiver, bool (R,); else it is ignored.

    Example:
        >>> curve = Detection(torch.tensor([-90.0]), 1.0, torch.tensor([0.001]).double(), torch.tensor([True]))
        >>> curve.given_detection(torch.tensor([[-80.0], [-95.0]]), torch.tensor(4.0))[0].round()[:, 0]
        tensor([-80., -88.])
    """

    limit: Annotated[Tensor, "float64 r"]
    width: PositiveFloat
    missed: Annotated[Tensor, "float64 r"]
    is_limit: Annotated[Tensor, "bool r"]

    @classmethod
    def estimate(
        cls,
        position: Tensor,
        rssi: Tensor,
        *,
        n_neighbours: int = 6,
        min_values: int = 3,
        min_own_values: int = 2,
        misses_worth: float = 30.0,
        limit_std_db: float = 20.0,
    ) -> Self | None:
        """Estimate the curve by greatest likelihood, from cells with values in nearby rows, without a model of the power.

        The level of a cell is the mean value of nearby rows. An empty cell of a high level is missed at random, one of a low
        level is below the limit. Two steps alternate: limit and width of all receivers, and the limit of each receiver with
        a normal prior about that of all.

        Args:
            position: Positions of the rows, (n, 3) [m].
            rssi: Measurements (n, R) [dBm], nan where not detected; at least one value.
            n_neighbours: Number of nearby rows that determine the level of a cell. Not studied.
            min_values: Least number of values among them for limit and width of all receivers. Not studied.
            min_own_values: Least number of values among them for the limit of one receiver, which has fewer cells.
            misses_worth: Prior strong cells: a receiver with 30 of them weighs its own fraction of misses and that of all
                receivers equally. Not studied.
            limit_std_db: Prior standard deviation of a receiver's limit about that of all [dB], by
                `benchmarks/not_detected.py --insensitive-dbm -70`.

        Returns:
            The curve; None if every cell has a value. With fewer than 5 empty cells near values all limits are the lowest
            value.

        Example:
            >>> import swiftwrf
            >>> room = swiftwrf.rssi_room(n=200)
            >>> weak = room.rssi_dbm.where(room.rssi_dbm > -60, torch.nan)
            >>> -61 < float(Detection.estimate(room.transmitter_position, weak).limit.median()) < -58
            True
        """
        if bool(rssi.isfinite().all()) or len(position) < 2:
            return None
        is_limit, lowest = rssi.isnan().any(dim=0), float(rssi[~rssi.isnan()].min())
        position, rssi = subsample(position, rssi, rows=1500)
        seen, missed = ~rssi.isnan(), MISSES[0].repeat(rssi.shape[1])
        number = Neighbours(position)(position, min(n_neighbours + 1, len(position)))[1]
        near = rssi[number].masked_fill((number == torch.arange(len(rssi))[:, None])[..., None], torch.nan)
        level, n_near = near.nanmean(dim=1), (~near.isnan()).sum(dim=1)
        usable, offset = n_near >= min_values, torch.zeros_like(missed)
        if int((usable & ~seen).sum()) < 5 or int((usable & seen).sum()) < 5:
            return cls(offset + lowest, 0.5, missed, is_limit)
        spread = 1.25 * float((rssi - level)[usable & seen].abs().mean())

        widths = 0.5, 1.0, 2.0, 3.0, 5.0, 8.0  # [dB]
        offsets = torch.arange(-40.0, 41.0, dtype=torch.float64)  # of a receiver's limit about that of all [dB]

        def cells(min_near: int, rows: int) -> Iterator[Cells]:
            for value, kind in ((rssi, seen), (level, ~seen)):
                every = (kind & (n_near >= min_near)).nonzero()
                row, receiver = subsample(every, rows=rows)[0].T
                yield value[row, receiver], receiver, max(1.0, len(every) / rows)

        shared, each = list(cells(min_values, 4000)), list(cells(min_own_values, 50_000))
        for _ in range(5):
            kept, lost = ((db - offset[receiver], receiver, weight) for db, receiver, weight in shared)
            limits = torch.linspace(float(kept[0].min()) - 0.5, float(kept[0].median()), 30, dtype=torch.float64)
            likely = torch.stack([_log_likelihoods(kept, lost, limits, w, spread, len(offset)).sum(-1) for w in widths])
            best = np.unravel_index(int(likely.argmax()), likely.shape)
            width, misses, limit = widths[best[0]], MISSES[best[1]], limits[best[2]]
            kept, lost = ((db - limit, receiver, weight) for db, receiver, weight in each)
            score = _log_likelihoods(kept, lost, offsets, width, spread, len(offset))
            score += misses_worth * (misses * MISSES.log() + (1 - misses) * (-MISSES).log1p())[:, None, None]
            score -= (offsets / limit_std_db).square()[:, None] / 2
            previous, offset = offset, offsets[score.amax(dim=0).argmax(dim=0)]
            if torch.equal(previous, offset):
                break
        strong = usable & (level > limit + offset + 2 * math.hypot(spread, width))
        lost_count = (strong & ~seen).sum(dim=0).double() + misses_worth * misses
        return cls(limit + offset, width, lost_count / (strong.sum(dim=0) + misses_worth), is_limit)

    @classmethod
    def of_lists(cls, rssi: Tensor, margin_db: float, *, width: float = 2.0) -> tuple[Self, Tensor]:
        """Return the curve of rows that list the strongest or associated receivers, and the shift of each cell.

        A cell is empty if its power is below the weakest value of its row and a margin. The limit of the curve is one number
        for all rows: with the shift, the power of an empty cell counts from the limit of its row. A value has no shift, and
        is far above the limit, since every power may be listed.

        Args:
            rssi: Measurements (n, R) [dBm], nan where not listed.
            margin_db: Margin above the weakest value of a row.
            width: Standard deviation of the limit over rows [dB]. Not studied.

        Returns:
            Curve, and shift (n, R) [dB].

        Example:
            >>> curve, shift = Detection.of_lists(torch.tensor([[-60.0, float("nan")]]), 8.0)
            >>> curve.limit - shift  # limit of the power in each cell
            tensor([[-1000.,   -52.]], dtype=torch.float64)
        """
        n_receivers, far_below, far_above = rssi.shape[1], -1000.0, 1000.0  # [dBm]
        weakest = rssi.double().nan_to_num(torch.inf).amin(dim=1, keepdim=True) + margin_db
        weakest = weakest.where(weakest.isfinite(), far_above)  # a row without a value has no limit
        each = torch.ones(n_receivers, dtype=torch.float64)
        curve = cls(far_below * each, width, MISSES[0] * each, torch.ones(n_receivers, dtype=torch.bool))
        return curve, (far_below - weakest).expand(rssi.shape).where(rssi.isnan(), 0.0)

    def note(self, receiver_names: Sequence[str]) -> str:
        """Return a sentence on the meaning of empty cells of these R receivers."""
        weak = [name for name, limit in zip(receiver_names, self.is_limit.tolist(), strict=True) if limit]
        others = [name for name in receiver_names if name not in weak]
        missed = float(self.missed[self.is_limit].mean()) if weak else 0.0
        clauses = []
        if weak:
            limits = dict.fromkeys(f"{limit:.0f}" for limit in self.limit[self.is_limit].aminmax())
            clauses.append(f"an empty cell means that the signal was below about {' to '.join(limits)} dBm")
            if missed > 0.03:
                clauses.append(f"{missed:.0%} of all packets are missed at any power")
        if others:
            where = f"at {len(others)} of {len(receiver_names)} receivers ({listed(others[:5])})" if weak else "here"
            clauses.append(f"{where} empty cells say nothing")
        return ", ".join(clauses)

    def columns(self, number: Tensor | slice) -> Self:
        """Return the curve of the receivers `number`."""
        return replace(self, **{name: getattr(self, name)[number] for name in ("limit", "missed", "is_limit")})

    def given_detection(self, mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean [dBm] and standard deviation [dB] of the power of detected packets, by those of all, each (n, R)."""
        spread = (std.square() + self.width**2).sqrt()
        z = (mean - self.limit) / spread
        hazard = (-z.square() / 2 - math.log(2 * math.pi) / 2 - torch.special.log_ndtr(z)).exp()
        shrunk = 1 - (std / spread).square() * hazard * (z + hazard)
        given = mean + std.square() / spread * hazard, std * shrunk.clamp_min(0.05).sqrt()
        return given[0].where(self.is_limit, mean), given[1].where(self.is_limit, std)


def _log_likelihoods(kept: Cells, lost: Cells, limit: Tensor, width: float, spread: float, n_receivers: int) -> Tensor:
    """Return log-likelihoods (7, L, R) of values and of levels of empty cells, for fractions of misses and limits (L,).

    `spread` is the standard deviation of a value about its level [dB].
    """
    above = torch.special.log_ndtr((kept[0] - limit[:, None]) / width)
    below = torch.special.ndtr((limit[:, None] - lost[0]) / math.hypot(spread, width))

    def summed(logarithm: Tensor, cells: Cells) -> Tensor:
        none = torch.zeros(len(limit), n_receivers, dtype=torch.float64)
        return cells[2] * none.index_add(1, cells[1], logarithm)

    seen, n_seen = summed(above, kept), kept[2] * kept[1].bincount(minlength=n_receivers)
    return torch.stack([seen + n_seen * (-m).log1p() + summed((m + (1 - m) * below).log(), lost) for m in MISSES])


@dataclass(frozen=True, eq=False)
class DetectionField:
    """Probability that a packet is detected: logistic in the received power and in the fraction of detections nearby.

    This fraction is a Gaussian process of the position, which follows what no path loss explains, e.g. a receiver that was
    off.

    Args:
        process: Process of the detections (1 or 0) less their mean at each receiver, (n, R) at n bins.
        mean: Fraction of the bins where each receiver detects something, float64 (R,).
        limit: Received power that the logistic curve of each receiver counts from, float64 (R,) [dBm].
        weight: Constant, weight of the power [per 10 dB], and weight of the fraction, float64 (3,).
    """

    process: Annotated[GaussianProcess, "k=r"]
    mean: Annotated[Tensor, "float64 r"]
    limit: Annotated[Tensor, "float64 r"]
    weight: Annotated[Tensor, "float64 3"]

    @classmethod
    def fit(
        cls, kernel: Kernel, position: Tensor, detected: Tensor, fold: Tensor, level: Tensor, limit: Tensor
    ) -> tuple[Self, Tensor]:
        """Fit to bins, detected or not, bool (n, R), with held-out predictions `level` of their power, (n, R) [dBm].

        Return the field, and the log-likelihood of each bin by the detections nearby in other folds, (n, R).
        """
        value, mean = detected.double(), detected.double().mean(dim=0)
        process = GaussianProcess(kernel, position, value - mean)
        nearby = torch.empty_like(value)
        for out, kept, weight, _ in leave_folds_out(kernel, position, fold):
            of_kept = value[kept].mean(dim=0)
            nearby[out] = of_kept + weight @ (value[kept] - of_kept)
        feature = torch.stack([(level - limit) / 10, nearby], dim=-1)
        kinds, order = detected.flatten().sort(stable=True)  # the first and the last cell, one of each kind, are kept
        some, kinds = subsample(feature.flatten(0, 1)[order], kinds, rows=80_000)
        from sklearn.linear_model import LogisticRegression  # takes half a second, which only a fit needs

        regression = LogisticRegression(C=100.0).fit(some.numpy(), kinds.numpy())
        weight = torch.tensor([*regression.intercept_, *regression.coef_[0]], dtype=torch.float64)
        odds = weight[0] + feature @ weight[1:]
        return cls(process, mean, limit, weight), logsigmoid(odds.where(detected, -odds))

    def probability(self, level: Tensor, position: Tensor) -> Tensor:
        """Return the probability of a detection, float64 (m, R), by the power (m, R) [dBm] at positions (m, 3) [m]."""
        nearby = self.mean + self.process.mean(position)
        return torch.sigmoid(self.weight[0] + self.weight[1] * (level - self.limit) / 10 + self.weight[2] * nearby)

    def updated(self, position: Tensor, detected: Tensor) -> Self:
        """Return the field with more rows, detections bool (m, R) at positions (m, 3) [m]."""
        return replace(self, process=self.process.updated(position, detected.double() - self.mean))


def empty_given(z: Tensor, missed: Tensor) -> tuple[Tensor, Tensor]:
    """Return how an empty cell changes a power that is z standard deviations below the limit.

    With p = missed + (1 - missed) Phi(z), the probability of the empty cell, also for z far below 0:

    Returns:
        (1 - missed) phi(z) / p, the derivative of log p by z, and (1 - missed) Phi(z) / p, the probability that the cell is
        empty because of a weak signal.
    """
    below = torch.special.log_ndtr(z)
    empty = torch.logaddexp((missed / (1 - missed)).log().expand_as(z), below)
    return (-z.square() / 2 - math.log(2 * math.pi) / 2 - empty).exp(), (below - empty).exp()
