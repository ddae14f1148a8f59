"""Predictors that look at no neighbour: the mean, and the log-distance law."""

from __future__ import annotations

from torch import Tensor

from swiftwrf import InputError, Rssi
from swiftwrf.rssi import fit_law, log_distance
from tasks.rssi.predictors.base import PREDICTORS, RECEIVERS, Predictor, Settings


class Mean:
    """The mean of each receiver's training values, wherever the transmitter is."""

    def fit(self, train: Rssi) -> None:
        # a receiver never heard in the training part has the mean of the others
        self._mean = train.rssi_dbm.nanmean(dim=0).nan_to_num(float(train.rssi_dbm.nanmean()))

    def predict(self, position: Tensor) -> Tensor:
        return self._mean.expand(len(position), -1)


class LogDistance:
    """RSSI = T - 10 gamma log10 d by least squares (the log-distance law; "MRI" in the NeRF2 repository and, most likely,
    in the paper's table), for each receiver, or one for all.

    Args:
        pooled: one law for all receivers.
        pool: the rows that the law of all is fitted to; None: those that `fit` is given. It also stands for the law of a
            receiver never heard.
    """

    def __init__(self, pooled: bool, pool: Rssi | None = None) -> None:
        self._pooled, self._pool = pooled, pool

    def fit(self, train: Rssi) -> None:
        if not train.located:
            raise InputError(f"the log-distance law needs the {RECEIVERS}, which {train.name} does not tell")
        self._receiver = train.receiver_position
        rows = self._pool or train
        self._law = fit_law(log_distance(rows.transmitter_position, rows.receiver_position), rows.rssi_dbm, pooled=True)
        if not self._pooled:
            own = fit_law(log_distance(train.transmitter_position, self._receiver), train.rssi_dbm)
            self._law = own.where((~train.rssi_dbm.isnan()).any(dim=0), self._law)

    def predict(self, position: Tensor) -> Tensor:
        return self._law(log_distance(position, self._receiver))


@PREDICTORS.register("mean")
def _mean(settings: Settings) -> Predictor:
    return Mean()


@PREDICTORS.register("mri_pooled")
def _mri_pooled(settings: Settings) -> Predictor:
    return LogDistance(pooled=True, pool=settings.pool)


@PREDICTORS.register("mri_receiver")
def _mri_receiver(settings: Settings) -> Predictor:
    return LogDistance(pooled=False)
