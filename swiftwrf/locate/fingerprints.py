"""Similar training rows: the neighbours of a row of RSSI are places, which vote for a floor and are averaged on it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import torch
from torch import Tensor

from swiftwrf.data.coordinates import Floors
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import places

NEIGHBOUR_COUNTS = (1, 2, 3, 4, 5, 7, 9, 12, 16, 20)
METRICS = ("sorensen", "manhattan", "euclidean")  # the first one unless another has a significantly lower error
MAX_HELD_OUT = 1000  # rows that choose the settings
SMALLEST_DISTANCE = 1e-3  # of fingerprints, whose inverse is a weight
Votes = tuple[Tensor, Tensor, Tensor]  # each floor's part of the weights, its mean position, and the estimate


@dataclass(frozen=True, eq=False)
class Fingerprints:
    """Training rows as a search for the k places with the most similar RSSI.

    RSSI counts as its excess over a value below the weakest one, 0 if not detected: 5 dB below and to the power of e for
    Sorensen's distance, sum |a - b| / sum (a + b), and 1 dB below for the others (J. Torres-Sospedra et al., Expert Systems
    with Applications 42, 2015). The distance of a place is that of its most similar row.

    Args:
        position: Training positions, float64 (n, 3) [m].
        rssi: Their RSSI, float32 (n, R) [dBm], nan where not detected.
        floors: Floors of the building, of which the neighbours vote for one. None if there is one only.
        metric: One of `METRICS`.
        k: Number of places.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.rssi_room(n=60).split()
        >>> Fingerprints.of(train, k=3).estimate(test.rssi_dbm).shape
        torch.Size([12, 3])
    """

    position: Tensor
    rssi: Tensor
    floors: Floors | None = None
    metric: str = METRICS[0]
    k: int = 1

    @classmethod
    def of(cls, train: Rssi, metric: str = METRICS[0], k: int = 1) -> Self:
        """Return the detected rows of the training data as fingerprints."""
        train = train.subset(train.detected.any(dim=1))
        return cls(train.transmitter_position, train.rssi_dbm.float(), train.floors, metric, k)

    @classmethod
    def fit(cls, train: Rssi, fold: Tensor, seed: int = 0) -> Self:
        """Return fingerprints with the metric and k of the lowest mean error at held-out rows.

        Args:
            train: Training rows.
            fold: Fold of each row (n,).
            seed: Seed of the choice of held-out rows.
        """
        detected = train.detected.any(dim=1)
        train, fold = train.subset(detected), fold[detected]
        order = torch.randperm(len(train), generator=torch.Generator().manual_seed(seed))
        held_out = torch.zeros(len(train), dtype=torch.bool).index_fill(0, order[:MAX_HELD_OUT], value=True)
        parts = [((fold == number) & held_out, fold != number) for number in fold.unique()]
        errors: dict[tuple[str, int], Tensor] = {}
        fewest = min(len(train.transmitter_position[kept].unique(dim=0)) for _, kept in parts)
        counts = [k for k in NEIGHBOUR_COUNTS if k <= fewest]
        for metric in METRICS:
            error = []
            for out, kept in parts:
                found = cls.of(train.subset(kept), metric)
                near = found.nearest(train.rssi_dbm[out], counts[-1])
                truth = train.transmitter_position[out]
                error.append(torch.stack([(found.vote(near, k)[2] - truth).norm(dim=1) for k in counts]))
            errors |= {(metric, k): e for k, e in zip(counts, torch.cat(error, dim=1), strict=True)}
        usual, best = (
            min(names, key=lambda name: float(errors[name].mean()))
            for names in ([(METRICS[0], k) for k in counts], list(errors))
        )
        gain = errors[usual] - errors[best]
        better = float(gain.mean()) > 2 * float(gain.std()) / len(gain) ** 0.5
        return cls.of(train, *(best if better else usual))

    @cached_property
    def _places(self) -> tuple[Tensor, Tensor]:
        """Positions of the places (P, 3) [m] in the order of the rows, which decides ties, and the place of each row."""
        row = places(self.position, 1)
        return self.position[torch.zeros(int(row.max()) + 1).long().scatter_(0, row, torch.arange(len(row)))], row

    @cached_property
    def _known(self) -> tuple[Tensor, Tensor]:
        """Excess of each receiver in the rows (R, n), and its sum (n,)."""
        excess = self._excess(self.rssi).T.contiguous()
        return excess, excess.sum(dim=0)

    def _excess(self, rssi: Tensor) -> Tensor:
        sorensen = self.metric == "sorensen"
        weakest = float(self.rssi[~self.rssi.isnan()].min()) - (5.0 if sorensen else 1.0)
        excess = (rssi.float() - weakest).clamp_min(0.0).nan_to_num(0.0)
        return excess**math.e if sorensen else excess

    def nearest(self, rssi: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """Return the distances (m, k) of the k most similar places to rows of RSSI (m, R) [dBm], and their numbers."""
        place, number = self._places
        known, total = self._known
        found = []
        for row in self._excess(rssi):
            detected = row.nonzero()[:, 0]
            if self.metric == "euclidean":
                apart = (known - row[:, None]).square().sum(dim=0).sqrt()
            else:  # |a - b| = a + b - 2 min(a, b), and few receivers detect a row
                both = row.sum() + total
                apart = both - 2 * torch.minimum(known[detected], row[detected, None]).sum(dim=0)
                apart = apart / both.clamp_min(1e-9) if self.metric == "sorensen" else apart
            least = torch.full((len(place),), torch.inf).scatter_reduce(0, number, apart, "amin")
            nearest, order = least.sort(stable=True)
            found.append((nearest[:k], order[:k]))
        distances, numbers = zip(*found, strict=True) if found else ((rssi.new_zeros(0, k),), (number[:0, None],))
        return torch.stack(distances), torch.stack(numbers)

    def floor(self, position: Tensor) -> Tensor:
        """Return the number of the floor of each position (m, 3), 0 without floors, int64 (m,)."""
        if self.floors is None:
            return torch.zeros(len(position), dtype=torch.int64)
        return self.floors.number(position)

    def vote(self, near: tuple[Tensor, Tensor], k: int) -> Votes:
        """Return each floor's part of the weights (m, F), its mean position (m, F, 3) [m] and the estimate (m, 3) [m].

        Args:
            near: Distances and numbers of places, as of `nearest`.
            k: Number of places that vote, with the inverse distance as weight.
        """
        position = self._places[0][near[1][:, :k]]
        weight = 1 / near[0][:, :k].double().clamp_min(SMALLEST_DISTANCE)
        number = self.floor(position.reshape(-1, 3)).reshape(position.shape[:2])
        floor = torch.arange(1 if self.floors is None else len(self.floors.names))
        own = weight[..., None] * (number[..., None] == floor)
        total = own.sum(dim=1)
        mean = torch.einsum("mkf,mkc->mfc", own, position) / total[..., None].clamp_min(1e-12)
        best = total.argmax(dim=1)
        return total / total.sum(dim=1, keepdim=True), mean, mean[torch.arange(len(mean)), best]

    def votes(self, rssi: Tensor) -> Votes:
        """Return the votes of the k most similar places to rows of RSSI (m, R) [dBm]."""
        return self.vote(self.nearest(rssi, self.k), self.k)

    def estimate(self, rssi: Tensor) -> Tensor:
        """Return the weighted mean position (m, 3) [m] of the k most similar places on the floor that they vote for."""
        return self.votes(rssi)[2]
