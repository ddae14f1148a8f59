"""Predictors that use no neighbours: the mean, and the log-distance path-loss model."""

from __future__ import annotations

from torch import Tensor

from swiftwrf import Rssi
from swiftwrf.rssi import PathLoss, RssiFitContext, RssiPredictor, fit_path_loss, fit_shared_path_loss, log_distance


class Mean(RssiPredictor):
    """The mean of the receiver's training values, at every position.

    A receiver that no training row detected has the mean of the others.
    """

    name = "mean"

    def _fit(self, train: Rssi, context: RssiFitContext) -> None:
        self._mean = train.rssi_dbm.nanmean(dim=0).nan_to_num(float(train.rssi_dbm.nanmean()))

    def _predict(self, position: Tensor) -> tuple[Tensor, None]:
        return self._mean.expand(len(position), -1), None


class SharedPathLoss(RssiPredictor):
    """One log-distance path-loss model for all receivers of the pool, by least squares.

    Receivers of unknown position share one level.

    "MRI" is its name in the NeRF2 repository and, most likely, in the paper's table.
    """

    name = "mri_pooled"
    requires_receiver_position = True

    def _fit(self, train: Rssi, context: RssiFitContext) -> None:
        self._receiver = train.receiver_position
        self._path_loss = _fit_shared(context.pool, train)

    def _predict(self, position: Tensor) -> tuple[Tensor, None]:
        return self._path_loss(log_distance(position, self._receiver)), None


class ReceiverPathLoss(SharedPathLoss):
    """A log-distance path-loss model for each receiver; a receiver never detected has the model of all receivers."""

    name = "mri_receiver"

    def _fit(self, train: Rssi, context: RssiFitContext) -> None:
        self._receiver = train.receiver_position
        detected = (~train.rssi_dbm.isnan()).any(dim=0)
        own = fit_path_loss(log_distance(train.transmitter_position, train.receiver_position), train.rssi_dbm)
        self._path_loss = own.where(detected, _fit_shared(train, train))


def _fit_shared(rows: Rssi, applied: Rssi) -> PathLoss:
    distance = log_distance(rows.transmitter_position, rows.receiver_position)
    return fit_shared_path_loss(distance, rows.rssi_dbm, rows.receiver_located, applied.receiver_located)
