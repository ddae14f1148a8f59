"""RSSI where both ends of the link move: one model over pairs of positions.

    rssi(p, q) = T_q - 10 gamma_q log10 |p - q| + c(p, r q)       [dBm]

p and q are the positions of both ends, c is a Gaussian process over the six coordinates, and r is a ratio of lengths. T and
gamma are those of all receivers, so that the model predicts ends at positions where none was measured. If only receivers at
known places are predicted, they depend on the place, by a ridge regression.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Self

import torch
from annotated_types import Gt, Lt
from torch import Tensor

from swiftwrf.data.dataset import Numbers
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.splits import each_fold, folds, places
from swiftwrf.errors import InputError
from swiftwrf.gp import GaussianProcess, Kernel
from swiftwrf.gp.process import leave_folds_out_locally
from swiftwrf.metrics import HALF_WIDTH, interval_factor
from swiftwrf.models.base import FieldConfig
from swiftwrf.models.prediction import Prediction
from swiftwrf.positions import check_positions, nearest
from swiftwrf.rssi.base import RECEIVER_POSITIONS, RssiPredictor, in_batches
from swiftwrf.rssi.path_loss import MIN_DISTANCE_M, fit_path_loss
from swiftwrf.rssi.training import rough_candidates, rounding_std
from swiftwrf.runtime.checkpoint import Saved
from swiftwrf.runtime.threads import single_thread
from swiftwrf.runtime.validation import configuration

BATCH_PAIRS = 2048  # predicted at a time, since each needs a matrix of 64 x 64


@configuration
class PairConfig(FieldConfig):
    """Options of models over pairs of positions."""

    new_places: bool = True
    """True: receivers are predicted at new positions, so all have one path loss, and folds hold out receivers. False:
    receivers are the same, so each has a correction, and folds hold out positions of the transmitter (`validation`)"""


@dataclass(frozen=True, eq=False)
class PairPathLoss:
    """The log-distance path-loss model over pairs of positions: one for all receivers, and corrections of places.

    Args:
        shared: RSSI at 1 m [dBm] and slope [dB a decade] of all receivers, float64 (2,).
        place: Positions of the receivers with a correction, float64 (P, 3) [m].
        correction: What is added to RSSI at 1 m and slope at these places, float64 (P, 2).

    Example:
        >>> pair = torch.tensor([[0.0, 0, 1, 0, 0, 0], [0.0, 0, 10, 0, 0, 0]])
        >>> PairPathLoss.fit(pair, torch.tensor([-40.0, -60.0]), by_place=False)(pair)
        tensor([-40., -60.], dtype=torch.float64)
    """

    shared: Annotated[Tensor, "float64 2"]
    place: Annotated[Tensor, "float64 p 3"]
    correction: Annotated[Tensor, "float64 p 2"]

    @classmethod
    def fit(cls, pair: Tensor, rssi: Tensor, by_place: bool, rows_worth: float = 10.0) -> Self:
        """Fit the model by least squares, the corrections with a ridge penalty.

        Args:
            pair: Positions of transmitter and receiver, (m, 6) [m].
            rssi: Measurements (m,) [dBm].
            by_place: Whether each position of a receiver has a correction.
            rows_worth: Ridge penalty. A place with 10 measurements has half of their mean residual. Not studied.
        """
        distance = _pair_log_distance(pair)
        shared = torch.cat(fit_path_loss(distance[:, None], rssi[:, None].double()))
        place, row = pair[: len(pair) if by_place else 0, 3:].double().unique(dim=0, return_inverse=True)
        if not len(place):
            return cls(shared, place.reshape(0, 3), torch.zeros(0, 2, dtype=torch.float64))
        centre = distance.mean()
        feature = torch.stack([torch.ones_like(distance), distance - centre], dim=1)
        normal = rows_worth * torch.eye(2).double().repeat(len(place), 1, 1)
        normal = normal.index_add(0, row, feature[:, :, None] * feature[:, None])
        residual = rssi - shared[0] - shared[1] * distance
        right = torch.zeros(len(place), 2, dtype=torch.float64).index_add(0, row, feature * residual[:, None])
        slope = torch.linalg.solve(normal, right)[:, 1].clamp_max(-shared[1])  # the sum of both slopes is at most 0
        level = (right[:, 0] - normal[:, 0, 1] * slope) / normal[:, 0, 0]
        return cls(shared, place, torch.stack([level - slope * centre, slope], dim=1))

    def __call__(self, pair: Tensor) -> Tensor:
        """Return the RSSI (m,) [dBm] at pairs (m, 6) [m]; at places without a correction by the shared model."""
        values = self.shared.expand(len(pair), 2)
        if len(self.place) and len(pair):
            distance, number = nearest(pair[:, 3:], self.place, 1)
            values = values + self.correction[number[:, 0]].where(distance < 1e-3, 0.0)
        return values[:, 0] + values[:, 1] * _pair_log_distance(pair)


def _pair_log_distance(pair: Tensor) -> Tensor:
    """Return the log10 of the distances [m] between the ends of pairs (m, 6), float64 (m,)."""
    squared = (pair[:, :3].double() - pair[:, 3:].double()).square().sum(dim=1)
    return squared.clamp_min(MIN_DISTANCE_M**2).log10() / 2


class PairPredictor(RssiPredictor):
    """Base class of predictors over pairs of positions of transmitter and receiver; all receivers are alike.

    A subclass implements `_fit_pairs` and `_at_pairs` instead of `_fit` and `_predict`.
    """

    config_type = PairConfig
    requires_receiver_position = True

    @classmethod
    def lacking(cls, data: Rssi) -> str:
        """Return a sentence if the position of a receiver is unknown, or an empty text."""
        known = bool(data.receiver_located.all())
        return "" if known else f"{cls.name} needs the {RECEIVER_POSITIONS}, which {data.name} does not describe"

    @classmethod
    def compared(cls, data: Rssi) -> bool:
        """Return True if both ends move."""
        return data.receiver_moves

    @abstractmethod
    def _fit_pairs(self, pair: Tensor, rssi: Tensor, fold: Tensor) -> None:
        """Fit to RSSI (m,) [dBm] at pairs (m, 6) [m], with numbers of the groups to hold out (m,)."""

    @abstractmethod
    def _at_pairs(self, pair: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return RSSI (m,) [dBm] and its standard deviation, or None, at pairs (m, 6) [m]."""

    def _fit(self, train: Rssi, **_: Any) -> None:
        row, column = train.detected.nonzero(as_tuple=True)
        pair = torch.cat([train.transmitter_position[row], train.receiver_position[column]], dim=1)
        session = None if train.session is None else train.session[row]
        fold = folds(pair[:, :3], self.config.validation, self.config.seed, session=session)
        if self.config.new_places and len(pair[:, 3:].unique(dim=0)) > 1:
            fold = folds(pair[:, 3:], "random", self.config.seed)
        self._fit_pairs(pair, train.rssi_dbm[row, column], fold)

    def _predict(self, position: Tensor) -> tuple[Tensor, Tensor | None]:
        n, r = len(position), len(self.receiver_position)
        pair = torch.cat([position.repeat_interleave(r, dim=0), self.receiver_position.repeat(n, 1)], dim=1)
        mean, std = in_batches(self._at_pairs, pair, BATCH_PAIRS)
        return mean.reshape(n, r), None if std is None else std.reshape(n, r)

    def predict_detected(self, data: Rssi | Numbers) -> Prediction:
        """Predict the RSSI where it is measured; nan elsewhere, which saves time where a row has few receivers."""
        if not isinstance(data, Rssi):
            return self.predict(data)
        data = self.aligned(data)
        row, column = data.detected.nonzero(as_tuple=True)
        predicted = self.predict_pairs(data.transmitter_position[row], self.receiver_position[column])

        def table(values: Tensor) -> Tensor:
            return torch.full(data.rssi_dbm.shape, torch.nan).double().index_put((row, column), values.double())

        return Prediction(table(predicted.mean), None if predicted.std is None else table(predicted.std))

    def predict_pairs(self, transmitter_position: Tensor, receiver_position: Tensor) -> Prediction:
        """Predict the RSSI of pairs of positions, measured or not.

        Args:
            transmitter_position: Positions of the transmitter, (m, 3) [m].
            receiver_position: Position of the receiver in each pair, (m, 3) [m].

        Returns:
            Mean (m,) [dBm], and the standard deviation of a measurement (m,) [dB] if the predictor has one.

        Raises:
            InputError: Positions of another shape or not finite, or a predictor that is not fitted.

        Example:
            >>> import swiftwrf
            >>> train = swiftwrf.rssi_room(n=60)
            >>> model = swiftwrf.PairModel().fit(train)
            >>> model.predict_pairs(train.transmitter_position, train.transmitter_position.flip(0)).mean.shape
            torch.Size([60])
        """
        self.check_fitted()
        ends = [check_positions(end) for end in (transmitter_position, receiver_position)]
        if len(ends[0]) != len(ends[1]):
            raise InputError(f"each pair needs two positions, got {len(ends[0])} and {len(ends[1])}")
        with torch.set_grad_enabled(torch.is_grad_enabled() and any(end.requires_grad for end in ends)):
            mean, std = in_batches(self._at_pairs, torch.cat(ends, dim=1), BATCH_PAIRS)
        return Prediction(mean if self.attenuation is None else mean + self.attenuation.between(*ends).to(mean), std)


def scaled(pair: Tensor, ratio: float) -> Tensor:
    """Return pairs (m, 6), the receiver's coordinates times a ratio: coordinates in which pairs are near to each other."""
    return pair * pair.new_tensor([1.0] * 3 + [ratio] * 3)


def choose_pair_kernel(
    pair: Tensor,
    residual: Tensor,
    fold: Tensor,
    order: Tensor,
    *,
    ratios: tuple[float, ...] = (0.5, 1.0, 2.0),
    noises: tuple[float, ...] = (0.03, 0.1, 0.3, 1.0, 3.0),
) -> tuple[Tensor, float, Kernel, Tensor]:
    """Choose ratio and kernel with the lowest mean absolute error at held-out pairs.

    Args:
        pair: Measured pairs (m, 6) [m].
        residual: Residuals of path-loss models fitted without each fold, (folds, m) [dB].
        fold: Number of the fold of each pair, (m,).
        order: Numbers of the pairs in random order, (m,).
        ratios: Compared ratios of distances of the transmitter to equivalent ones of the receiver. Not studied.
        noises: Compared variances of a measurement, relative to that of the field. Not studied.

    Returns:
        Numbers of the pairs that choose, (k,), ratio, kernel, and the absolute errors at these pairs relative to their
        standard deviations, (k,).
    """
    # more pairs do not change the choice
    rows, best = order[:500], (math.inf, 1.0, Kernel(), residual[0])
    truth = residual[fold[rows], rows]
    for ratio in ratios:
        coordinates = scaled(pair, ratio)
        near, weights = leave_folds_out_locally(coordinates, fold, rows)
        values = residual[fold[rows, None], near]
        for kernel in sorted(rough_candidates(coordinates, noises), key=lambda kernel: kernel.matern12_length):
            weight, variance = weights(kernel)
            error = (truth - (weight * values).sum(dim=1)).abs()
            if float(error.mean()) < best[0]:
                best = float(error.mean()), ratio, kernel, error / (variance + kernel.noise).sqrt()
    return rows, *best[1:]


class PairModel(PairPredictor, Saved):
    """A path-loss model in the distance of both ends, and a Gaussian process over both positions.

    A prediction conditions on the nearest 64 pairs (local Gaussian process). Lengths, noise and the ratio of the ends'
    lengths are those with the lowest error at held-out pairs, which also calibrate the standard deviation.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.rssi_room(n=60).split()
        >>> PairModel(new_places=False).fit(train).predict(test.transmitter_position).mean.shape
        torch.Size([12, 12])
    """

    kind: ClassVar[str] = "rssi pair model"
    name = "pairs"
    max_map_predictions = 60_000  # each needs a system of 64 equations

    saved = "kernel ratio path_loss pair residual scale_db"
    kernel: Kernel
    """kernel of the field, lengths in [m]"""
    ratio: Annotated[float, Gt(0), Lt(math.inf)]
    """factor of the receiver's coordinates, by which distances of both ends count"""
    path_loss: PairPathLoss
    """path-loss model, of all receivers or of each place"""
    pair: Annotated[Tensor, "float64 m 6"]
    """measured pairs [m]"""
    residual: Annotated[Tensor, "float64 m"]
    """residuals of the path-loss model [dB]"""
    scale_db: Annotated[Tensor, "float64 1"]
    """calibrated standard deviation of the field far from all measurements [dB]"""

    @single_thread()
    def _fit_pairs(self, pair: Tensor, rssi: Tensor, fold: Tensor) -> None:
        def path_loss(rows: Tensor) -> PairPathLoss:
            return PairPathLoss.fit(pair[rows], rssi[rows], by_place=not self.config.new_places)

        self.pair, self.path_loss = pair, path_loss(torch.arange(len(pair)))
        self.residual = rssi - self.path_loss(pair)
        order = torch.randperm(len(pair), generator=torch.Generator().manual_seed(self.config.seed))
        names, number = fold.unique(return_inverse=True)
        # one region only: none is left to predict it from
        fold = number if len(names) > 1 else torch.arange(len(fold)) % 2
        # residuals (folds, pairs) of the path-loss model fitted without each fold
        residual = torch.stack([rssi - path_loss(kept)(pair) for _, kept in each_fold(fold)])
        rows, self.ratio, self.kernel, score = choose_pair_kernel(pair, residual, fold, order)
        place = places(pair[rows, 3:] if self.config.new_places else pair[rows, :3], 2)  # of the end that is held out
        scale = interval_factor(score / HALF_WIDTH, place)
        self.scale_db = score.new_tensor([max(scale, rounding_std(rssi) / self.kernel.noise**0.5)])
        self._precompute()

    def region(self) -> Tensor:
        """Return the training positions (n, 3) [m], one for each pair."""
        return self.pair[:, :3]

    def _precompute(self) -> None:
        known = scaled(self.pair, self.ratio)
        self._process = GaussianProcess(self.kernel, known, self.residual[:, None], exact=False)

    @single_thread()
    def _at_pairs(self, pair: Tensor) -> tuple[Tensor, Tensor]:
        field, variance = self._process.mean_and_variance(scaled(pair, self.ratio))
        return self.path_loss(pair) + field[:, 0], self.scale_db * (variance + self.kernel.noise).sqrt()

    def _restored(self) -> None:
        super()._restored()
        if not bool(self.receiver_position.isfinite().all()):
            raise InputError("a position of its receivers is not finite")
        self._precompute()
