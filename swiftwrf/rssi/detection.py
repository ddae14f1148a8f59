"""Empty cells: the curve of detection, and received power given that a packet was, or was not, detected.

    p(detected | y) = (1 - missed_r) Phi((y - limit) / width)

y is the received power of a packet, limit and width are those of all receivers, and missed_r is the share of packets that
receiver r misses whatever their power. An empty cell is then an upper limit that may be wrong (censored regression with
misclassification: J. Tobin, Econometrica 26, 1958; J. A. Hausman et al., Journal of Econometrics 87, 1998).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from sklearn.linear_model import LogisticRegression
from torch import Tensor

from swiftwrf.errors import listed
from swiftwrf.gp import GaussianProcess, Kernel, leave_folds_out, subsample
from swiftwrf.positions import Neighbours

NEIGHBOURS, FEWEST = 6, 3  # rows beside a cell, and values among them, that determine its level
MISSED = 1e-3  # share of random misses at least: no value is impossible
MISSES_WORTH = 30.0  # strong cells of a receiver that count as much as the share of misses of all receivers
MAX_ROWS, MAX_CELLS = 1500, 1000  # that determine the curve


@dataclass(frozen=True, eq=False)
class Detection:
    """The curve of detection of R receivers.

    Args:
        limit: Received power at which half of the packets are detected [dBm].
        width: Standard deviation of the limit over packets [dB].
        missed: Share of packets of any power that each receiver misses, float64 (R,).
        is_limit: Whether an empty cell is an upper limit for its receiver, bool (R,); else it is ignored.

    Example:
        >>> curve = Detection(-90.0, 1.0, torch.tensor([0.001]).double(), torch.tensor([True]))
        >>> curve.given_detection(torch.tensor([[-80.0], [-95.0]]), torch.tensor(4.0))[0].round()[:, 0]
        tensor([-80., -88.])
    """

    limit: float
    width: float
    missed: Tensor
    is_limit: Tensor

    @classmethod
    def estimate(cls, position: Tensor, rssi: Tensor) -> Self | None:
        """Estimate the curve by greatest likelihood, from cells with values beside them; no model of the power is needed.

        What is missing beside strong values is missed at random, and what is missing beside weak ones is below the limit.

        Args:
            position: Positions of the rows, (n, 3) [m].
            rssi: Measurements (n, R) [dBm], nan where not detected; at least one value.

        Returns:
            The curve; None if every cell has a value. With fewer than 5 empty cells beside values the limit is the lowest
            value.

        Example:
            >>> import swiftwrf
            >>> room = swiftwrf.rssi_room(n=200)
            >>> weak = room.rssi_dbm.where(room.rssi_dbm > -60, torch.nan)
            >>> -61 < Detection.estimate(room.transmitter_position, weak).limit < -58
            True
        """
        if bool(rssi.isfinite().all()) or len(position) < 2:
            return None
        is_limit, lowest = rssi.isnan().any(dim=0), float(rssi[~rssi.isnan()].min())
        position, rssi = subsample(position, rssi, rows=MAX_ROWS)
        seen = ~rssi.isnan()
        number = Neighbours(position)(position, min(NEIGHBOURS + 1, len(position)))[1]
        near = rssi[number].masked_fill((number == torch.arange(len(rssi))[:, None])[..., None], torch.nan)  # (n, 7, R)
        level, usable = near.nanmean(dim=1), (~near.isnan()).sum(dim=1) >= FEWEST
        missed = torch.full((rssi.shape[1],), MISSED, dtype=torch.float64)
        if int((usable & ~seen).sum()) < 5 or int((usable & seen).sum()) < 5:
            return cls(lowest, 0.5, missed, is_limit)
        value, kept_level, lost_level = rssi[usable & seen], level[usable & seen], level[usable & ~seen]
        spread, share = 1.25 * float((value - kept_level).abs().mean()), len(value) / int(usable.sum())
        value, lost_level = (subsample(v.sort().values, rows=MAX_CELLS)[0] for v in (value, lost_level))
        limit = torch.linspace(float(rssi[seen].min()) - 0.5, float(value.median()), 30).double()[:, None, None, None]
        width = torch.tensor([0.5, 1, 2, 3, 5, 8]).double()[:, None, None]
        misses = torch.tensor([MISSED, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3]).double()[:, None]
        kept = (torch.special.log_ndtr((value - limit) / width) + (-misses).log1p()).mean(dim=-1)
        below = torch.special.ndtr((limit - lost_level) / (spread**2 + width.square()).sqrt())
        lost = (misses + (1 - misses) * below).log().mean(dim=-1)
        score = share * kept + (1 - share) * lost
        limits, widths, shares = np.unravel_index(int(score.argmax()), score.shape)
        found = float(limit.flatten()[limits]), float(width.flatten()[widths])
        strong = usable & (level > found[0] + 2 * math.hypot(spread, found[1]))
        lost_count = (strong & ~seen).sum(dim=0).double() + MISSES_WORTH * float(misses.flatten()[shares])
        return cls(*found, lost_count / (strong.sum(dim=0) + MISSES_WORTH), is_limit)

    def note(self, receiver_names: Sequence[str]) -> str:
        """Return a sentence on the meaning of empty cells of these R receivers."""
        weak = [name for name, limit in zip(receiver_names, self.is_limit.tolist(), strict=True) if limit]
        others = [name for name in receiver_names if name not in weak]
        missed = float(self.missed[self.is_limit].mean()) if weak else 0.0
        said = []
        if weak:
            said.append(f"an empty cell means that the signal was below about {self.limit:.0f} dBm")
            if missed > 0.03:
                said.append(f"{missed:.0%} of all packets are missed at any power")
        if others:
            where = f"at {len(others)} of {len(receiver_names)} receivers ({listed(others[:5])})" if weak else "here"
            said.append(f"{where} empty cells say nothing")
        return ", ".join(said)

    def columns(self, number: Tensor | slice) -> Self:
        """Return the curve of some receivers."""
        return replace(self, missed=self.missed[number], is_limit=self.is_limit[number])

    def given_detection(self, mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean [dBm] and standard deviation [dB] of the power of detected packets, by those of all, each (n, R)."""
        spread = (std.square() + self.width**2).sqrt()
        z = (mean - self.limit) / spread
        hazard = (-z.square() / 2 - math.log(2 * math.pi) / 2 - torch.special.log_ndtr(z)).exp()
        shrunk = 1 - (std / spread).square() * hazard * (z + hazard)
        given = mean + std.square() / spread * hazard, std * shrunk.clamp_min(0.05).sqrt()
        return given[0].where(self.is_limit, mean), given[1].where(self.is_limit, std)


@dataclass(frozen=True, eq=False)
class DetectionField:
    """Probability that a packet is detected: logistic in the received power and in the share of detections nearby.

    The share is a Gaussian process of the position, which follows what no path loss explains, e.g. a receiver that was off.

    Args:
        process: Process of the detections (1 or 0) less their mean at each receiver, (n, R) at n bins.
        mean: Fraction of the bins where each receiver detects something, float64 (R,).
        limit: Received power that the logistic curve counts from [dBm].
        weight: Constant, weight of the power [per 10 dB], and weight of the share, float64 (3,).
    """

    process: GaussianProcess
    mean: Tensor
    limit: float
    weight: Tensor

    @classmethod
    def fit(
        cls, kernel: Kernel, position: Tensor, detected: Tensor, fold: Tensor, level: Tensor, limit: float
    ) -> Self | None:
        """Fit to bins, detected or not, bool (n, R), with held-out predictions `level` of their power, (n, R) [dBm].

        The result is None if every cell is detected.
        """
        if bool(detected.all()):
            return None
        value, mean = detected.double(), detected.double().mean(dim=0)
        process = GaussianProcess(kernel, position, value - mean)
        share = torch.empty_like(value)
        for out, kept, weight, _ in leave_folds_out(kernel, position, fold):
            own = value[kept].mean(dim=0)
            share[out] = own + weight @ (value[kept] - own)
        known = level.isfinite()
        features = torch.stack([(level - limit) / 10, share], dim=-1)[known]
        detected, order = detected[known].sort(stable=True)  # the first and the last cell, one of each kind, are kept
        some = subsample(features[order], detected, rows=MAX_CELLS * 20)
        found = LogisticRegression(C=100.0).fit(some[0].numpy(), some[1].numpy())
        weight = torch.tensor([*found.intercept_, *found.coef_[0]], dtype=torch.float64)
        return cls(process, mean, limit, weight)

    def probability(self, level: Tensor, position: Tensor) -> Tensor:
        """Return the probability of a detection, float64 (m, R), by the power (m, R) [dBm] at positions (m, 3) [m]."""
        share = self.mean + self.process.mean(position)
        return torch.sigmoid(self.weight[0] + self.weight[1] * (level - self.limit) / 10 + self.weight[2] * share)

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
