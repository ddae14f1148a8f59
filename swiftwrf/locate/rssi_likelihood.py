"""Likelihoods of RSSI by the radio maps of all receivers: values, detections, and similar fingerprints."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Literal, Self, get_args

import numpy as np
import torch
from annotated_types import Ge, Gt, Lt
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit
from torch import Tensor

from swiftwrf.data.coordinates import Floors
from swiftwrf.data.dataset import Numbers
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import centres, each_fold, places
from swiftwrf.errors import InputError
from swiftwrf.locate.spectrum_likelihood import DEGREES, student_log_density
from swiftwrf.rssi import RssiModel
from swiftwrf.runtime.validation import PositiveFloat, PositiveInt

MAX_DETECTIONS = 200_000  # that determine the likelihood of detections
Metric = Literal["sorensen", "manhattan", "euclidean"]
METRICS: tuple[Metric, ...] = get_args(Metric)  # the first one unless another has a significantly lower error
MAX_HELD_OUT = 1000  # rows that choose the settings
Votes = tuple[Tensor, Tensor, Tensor]  # each floor's part of the weights, its mean position, and the estimate
Maps = tuple[Tensor, Tensor]  # predicted RSSI and its standard deviation at m positions, float32 (m, R) [dBm], [dB]


def maps_at(model: RssiModel, position: Numbers, *, smallest_db: float = 0.5) -> Maps:
    """Return the radio maps of a model at positions (m, 3) [m], with a smallest standard deviation [dB] (not studied)."""
    prediction = model.predict(position)
    assert prediction.std is not None
    return prediction.mean.float(), prediction.std.float().clamp_min(smallest_db)


@dataclass(frozen=True)
class ValueLikelihood:
    """Student distribution of the errors of the radio maps, which share the offset of a row (device, body, weather).

    Args:
        common_db: Standard deviation of the offset [dB].
        scale: Factor of the standard deviations of the maps.
        degrees: Degrees of freedom; infinite for a Gaussian.
    """

    common_db: Annotated[float, Ge(0), Lt(math.inf)]
    scale: Annotated[float, Gt(0), Lt(math.inf)]
    degrees: PositiveFloat

    @classmethod
    def fit(
        cls,
        maps: Maps,
        rssi: Tensor,
        *,
        common_db: Sequence[float] = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0),
        scales: Sequence[float] = (0.7, 0.85, 1.0, 1.2, 1.5, 2.0),
    ) -> ValueLikelihood:
        """Fit to held-out rows by maximum likelihood among a grid of values.

        Args:
            maps: Radio maps at the rows, (n, R).
            rssi: RSSI (n, R) [dBm], nan where not detected.
            common_db: Standard deviations of the offset that are compared [dB]. Not studied.
            scales: Factors of the standard deviations of the maps that are compared. Not studied.
        """
        weight = (~rssi.isnan()).double() / maps[1].double().square()
        error = (rssi - maps[0].double()).nan_to_num()
        sums = weight.sum(dim=1), (weight * error).sum(dim=1), (weight * error.square()).sum(dim=1)
        count = (weight > 0).sum(dim=1).double()
        choices = (cls(*values) for values in itertools.product(common_db, scales, DEGREES))
        return max(choices, key=lambda choice: float(choice._log_density(*sums, count).sum()))

    def log_likelihood(self, maps: Maps, rssi: Tensor) -> Tensor:
        """Return log-likelihoods (n, m) of RSSI (n, R) [dBm] at candidates with radio maps (m, R)."""
        middle = maps[0].mean(dim=0).double()  # sums of squares cancel less about it
        mean, weight = maps[0].double() - middle, 1 / maps[1].double().square()
        detected = (~rssi.isnan()).double()
        value = (rssi.double() - middle).nan_to_num()
        total = detected @ weight.T
        first = value @ weight.T - detected @ (weight * mean).T
        second = value.square() @ weight.T - 2 * value @ (weight * mean).T + detected @ (weight * mean.square()).T
        determinant = detected @ maps[1].double().log().T
        return self._log_density(total, first, second, detected.sum(dim=1, keepdim=True)) - determinant

    def sample(self, std: Tensor, generator: torch.Generator) -> Tensor:
        """Sample errors [dB] at standard deviations of the maps, float64 (..., R) [dB]."""

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64)

        offset = self.common_db * normal(*std.shape[:-1], 1)
        error: Tensor = offset + self.scale * std * normal(*std.shape)
        if math.isinf(self.degrees):
            return error
        # a Student variable is a Gaussian one over the root of a scaled chi-squared one
        rng = np.random.default_rng(int(torch.randint(2**31, (), generator=generator)))
        chi_squared = torch.from_numpy(rng.chisquare(self.degrees, offset.shape))
        return error / (chi_squared / self.degrees).sqrt()

    def _log_density(self, total: Tensor, first: Tensor, second: Tensor, count: Tensor) -> Tensor:
        """Return the log-density, without the determinant of the maps' standard deviations.

        `total`, `first` and `second` are sums over `count` receivers: of the weights, of weighted errors [dB], and of their
        squares. Weights are the inverse variances of the maps.
        """
        variance = self.scale**2
        ratio = self.common_db**2 / variance
        distance = (second - first.square() * ratio / (1 + ratio * total)).clamp_min(0) / variance
        determinant = count * math.log(self.scale) + torch.log1p(ratio * total) / 2
        return student_log_density(distance, self.degrees, count) - determinant


@dataclass(frozen=True, eq=False)
class DetectionLikelihood:
    """Likelihood of which receivers detect the transmitter: logistic in the predicted RSSI, with losses at any power.

    Args:
        threshold: RSSI at which each receiver detects half of the packets, float64 (R,) [dBm].
        width: Width of the transition [dB].
        loss: Probability that a strong packet is lost.
    """

    threshold: Annotated[Tensor, "float64 r"]
    width: PositiveFloat
    loss: Annotated[float, Ge(0), Lt(1)]

    @classmethod
    def fit(cls, mean: Tensor, detected: Tensor, limit: Tensor) -> DetectionLikelihood:
        """Fit to predicted RSSI (n, R) [dBm] and detections, bool (n, R), of held-out rows.

        The thresholds differ as the limits of detection, (R,) [dBm], do.
        """
        step = -(-mean.numel() // MAX_DETECTIONS)
        m, d = (mean.double() - limit).flatten()[::step], detected.flatten()[::step]

        def loss(raw: NDArray[np.float64]) -> float:
            chance = cls._of(raw).probability(m).clamp(1e-4, 1 - 1e-4)
            return -float(chance.where(d, 1 - chance).log().mean())

        start = np.array([float(m.quantile(0.1)), 1.5, -2.0])
        fitted = cls._of(minimize(loss, start, method="Nelder-Mead", options={"maxiter": 300}).x)
        return replace(fitted, threshold=fitted.threshold + limit)

    @classmethod
    def _of(cls, raw: NDArray[np.float64]) -> DetectionLikelihood:
        return cls(torch.tensor(raw[0]), float(np.exp(np.clip(raw[1], -1, 4))), float(0.9 * expit(raw[2])))

    def probability(self, mean: Tensor) -> Tensor:
        """Return the probability of a detection for each predicted RSSI (..., R) [dBm], of the same shape."""
        return (1 - self.loss) * torch.sigmoid((mean - self.threshold.to(mean)) / self.width)

    def log_likelihood(self, mean: Tensor, rssi: Tensor) -> Tensor:
        """Return log-likelihoods (n, m) of the detections in RSSI (n, R) at candidates of predicted RSSI (m, R)."""
        chance = self.probability(mean).clamp(1e-4, 1 - 1e-4)
        detected = (~rssi.isnan()).float()
        return detected @ chance.log().T + (1 - detected) @ (-chance).log1p().T


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
        >>> Fingerprints.of(train, k=3).votes(test.rssi_dbm)[2].shape
        torch.Size([12, 3])
    """

    position: Annotated[Tensor, "float64 n 3"]
    rssi: Annotated[Tensor, "float32 n r nan"]
    floors: Floors | None = None
    metric: Metric = METRICS[0]
    k: PositiveInt = 1

    @classmethod
    def of(cls, train: Rssi, metric: Metric = METRICS[0], k: int = 1) -> Self:
        """Return the detected rows of the training data as fingerprints."""
        train = train.subset(train.detected.any(dim=1))
        return cls(train.transmitter_position, train.rssi_dbm.float(), train.floors, metric, k)

    @classmethod
    def fit(
        cls, train: Rssi, fold: Tensor, seed: int = 0, *, counts: Sequence[int] = (1, 2, 3, 4, 5, 7, 9, 12, 16, 20)
    ) -> Self:
        """Return fingerprints with the metric and k of the lowest mean error at rows of held-out folds.

        Another metric than Sorensen's must be better by two standard errors.

        Args:
            train: Training rows.
            fold: Fold of each row, (n,).
            seed: Seed of the choice of at most 1000 rows.
            counts: Numbers of places k that are compared. Not studied.

        Raises:
            InputError: All rows with a detection are in one fold.
        """
        detected = train.detected.any(dim=1)
        train, fold = train.subset(detected), fold[detected]
        if len(fold.unique()) == 1:
            raise InputError(
                f"no rows of {train.name} can be held out to choose the neighbours: all detections are in one part of the "
                'region or one session; measure elsewhere, too, or take validation="random"'
            )
        order = torch.randperm(len(train), generator=torch.Generator().manual_seed(seed))
        parts = list(each_fold(fold, order[:MAX_HELD_OUT].sort().values))
        errors: dict[tuple[Metric, int], Tensor] = {}
        fewest = min(int(places(train.transmitter_position[kept]).max()) + 1 for _, kept in parts)
        counts = [k for k in counts if k <= fewest]
        for metric in METRICS:
            error = []
            for out, kept in parts:
                others = cls.of(train.subset(kept), metric)
                near = others.nearest(train.rssi_dbm[out], counts[-1])
                truth = train.transmitter_position[out]
                error.append(torch.stack([(others.vote(near, k)[2] - truth).norm(dim=1) for k in counts]))
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
        """Positions of the places (P, 3) [m], whose order decides ties, and the place of each row."""
        place = places(self.position)
        return centres(self.position, place), place

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
        neighbours = []
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
            neighbours.append((nearest[:k], order[:k]))
        if not neighbours:
            return rssi.new_zeros(0, k), number.new_zeros(0, k)
        distances, numbers = zip(*neighbours, strict=True)
        return torch.stack(distances), torch.stack(numbers)

    def floor(self, position: Tensor) -> Tensor:
        """Return the number of the floor of each position (m, 3), 0 without floors, int64 (m,)."""
        if self.floors is None:
            return torch.zeros(len(position), dtype=torch.int64)
        return self.floors.number(position)

    def vote(self, near: tuple[Tensor, Tensor], k: int, *, smallest_distance: float = 1e-3) -> Votes:
        """Return each floor's part of the weights (m, F), its mean position (m, F, 3) [m] and the estimate (m, 3) [m].

        Args:
            near: Distances and numbers of places, as of `nearest`.
            k: Number of places that vote, with the inverse distance as weight.
            smallest_distance: Distance that equal fingerprints count as, so that their weights are finite.
        """
        position = self._places[0][near[1][:, :k]]
        weight = 1 / near[0][:, :k].double().clamp_min(smallest_distance)
        number = self.floor(position.reshape(-1, 3)).reshape(position.shape[:2])
        floor = torch.arange(1 if self.floors is None else len(self.floors.names))
        of_floor = weight[..., None] * (number[..., None] == floor)
        total = of_floor.sum(dim=1)
        mean = torch.einsum("mkf,mkc->mfc", of_floor, position) / total[..., None].clamp_min(1e-12)
        best = total.argmax(dim=1)
        return total / total.sum(dim=1, keepdim=True), mean, mean[torch.arange(len(mean)), best]

    def votes(self, rssi: Tensor) -> Votes:
        """Return the votes of the k most similar places to rows of RSSI (m, R) [dBm]."""
        return self.vote(self.nearest(rssi, self.k), self.k)


@dataclass(frozen=True, eq=False)
class FingerprintLikelihood:
    """Likelihood of the position by the k most similar places.

    The floor has the neighbours' vote, with a probability that the vote misses it. On each floor the position has a Student
    distribution around the weighted mean of the neighbours there.

    Args:
        fingerprints: Training rows.
        scale_m: Scale of the distribution along each axis, (3,) [m].
        miss: Probability that a floor is as likely as any other, whatever the vote.
        degrees: Degrees of freedom.
    """

    fingerprints: Annotated[Fingerprints, "r"]
    scale_m: Annotated[Tensor, "float64 3", Gt(0)]
    miss: Annotated[float, Gt(0), Lt(1)] = 0.1
    degrees: PositiveFloat = 4.0

    @classmethod
    def fit(
        cls,
        fingerprints: Fingerprints,
        votes: Votes,
        truth: Tensor,
        smallest_m: float,
        *,
        misses: Sequence[float] = (0.003, 0.01, 0.03, 0.1, 0.2, 0.4),
    ) -> FingerprintLikelihood:
        """Fit to the votes of held-out rows.

        Args:
            fingerprints: Training rows.
            votes: Votes of n held-out rows.
            truth: Their positions (n, 3) [m].
            smallest_m: Smallest scale [m].
            misses: Probabilities that the vote misses the floor, of which the most likely one is taken. Not studied.
        """
        part = votes[0]
        rows, floor = torch.arange(len(truth)), fingerprints.floor(truth)
        right = part[rows, floor]
        error = (_with_estimate(votes)[rows, floor] - truth)[(right > 0) | (right == 0).all()]
        # a Student variable of 4 degrees of freedom is within 0.94 scales with a probability of 0.6
        scale = (error.abs().quantile(0.6, dim=0).square() + smallest_m**2).sqrt()

        def density(miss: float) -> float:
            return float(((1 - miss) * right + miss / part.shape[1]).log().mean())

        return cls(fingerprints, scale, max(misses, key=density))

    def log_likelihood(self, position: Tensor, rssi: Tensor) -> Tensor:
        """Return log-likelihoods (n, m) of candidate positions (m, 3) [m]."""
        votes = self.fingerprints.votes(rssi)
        part, mean = votes[0], _with_estimate(votes)
        number = self.fingerprints.floor(position)
        away = (position - mean[:, number]) / self.scale_m
        if part.shape[1] > 1:
            away[..., 2] = 0.0
        floor = ((1 - self.miss) * part + self.miss / part.shape[1]).log()
        return floor[:, number] + student_log_density(away.square().sum(dim=2), self.degrees, 3)


def _with_estimate(votes: Votes) -> Tensor:
    """Return the mean position on each floor (n, F, 3) [m], that of the estimate on floors without a neighbour."""
    part, mean, estimate = votes
    return mean.where(part[..., None] > 0, estimate[:, None])


@dataclass(frozen=True, eq=False)
class RssiLikelihoods:
    """Likelihoods of a row of RSSI that are pooled.

    Args:
        values: Distribution of the errors of the radio maps.
        detections: Likelihood of which receivers detect the transmitter.
        fingerprints: Likelihood of the position by similar training rows.
    """

    values: ValueLikelihood
    detections: Annotated[DetectionLikelihood, "r"]
    fingerprints: Annotated[FingerprintLikelihood, "r"]

    def __call__(self, position: Tensor, maps: Maps, rssi: Tensor) -> Tensor:
        """Return log-likelihoods, float64 (3, n, m), of RSSI (n, R) at candidates (m, 3) with radio maps (m, R)."""
        parts = (
            self.values.log_likelihood(maps, rssi),
            self.detections.log_likelihood(maps[0], rssi),
            self.fingerprints.log_likelihood(position, rssi),
        )
        return torch.stack([part.double() for part in parts])
