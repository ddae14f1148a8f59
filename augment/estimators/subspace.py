"""Estimators from array snapshots, without training: MUSIC, ESPRIT and maximum likelihood."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor

from augment import Mixed
from augment.estimators.base import ESTIMATORS, Estimator
from swiftwrf import InputError, Spectra
from swiftwrf.array.angles import to_angles
from swiftwrf.array.planar import PlanarArray
from swiftwrf.contrib.subspace import esprit, joint_music, maximum_likelihood, music

MIN_SNAPSHOTS = 2  # of one position: with one snapshot all methods are the peak of its spectrum


class SnapshotEstimator(Estimator):
    """Base class of estimators from array snapshots. A subclass implements `directions`."""

    trainable = False

    @staticmethod
    @abstractmethod
    def directions(array: PlanarArray, channel: Tensor, frequency_hz: Tensor | None) -> Tensor:
        """Return unit vectors (n, 3) from snapshots (n, S, K), at frequencies (S,) [Hz] if these are known."""

    def _fit(self, train: Mixed, device: torch.device) -> None:
        """Learn nothing."""

    def predict(self, spectra: Tensor) -> Tensor:
        raise InputError(
            f"{type(self).__name__} estimates directions from array snapshots; spectra do not contain them"
        )

    def estimate(self, data: Spectra) -> Tensor:
        if lacking := self.lacking(data):
            raise InputError(f"{type(self).__name__} is not possible: {lacking}")
        assert data.array is not None
        assert data.channel is not None
        return torch.stack(to_angles(self.directions(data.array, data.channel, data.frequency_hz)), dim=-1)

    @classmethod
    def lacking(cls, data: Spectra) -> str:
        needed = "several snapshots (subcarriers or packets) of each position are needed"
        if data.array is None or data.channel is None:
            return f"{needed}, and {data.name} contains spectra alone"
        if data.channel.shape[1] < MIN_SNAPSHOTS:
            return f"{needed}, and {data.name} contains one"
        try:
            cls.directions(data.array, data.channel[:1], data.frequency_hz)
        except InputError as error:
            return str(error)
        return ""


@ESTIMATORS.register("music")
class Music(SnapshotEstimator):
    """The direction of one source by MUSIC.

    Example:
        >>> Music().predict(torch.zeros(1, 9, 36))
        Traceback (most recent call last):
        swiftwrf.errors.InputError: Music estimates directions from array snapshots; spectra do not contain them
    """

    @staticmethod
    def directions(array: PlanarArray, channel: Tensor, frequency_hz: Tensor | None) -> Tensor:
        return music(array, channel)


@ESTIMATORS.register("esprit")
class Esprit(SnapshotEstimator):
    """The direction of one source by ESPRIT."""

    @staticmethod
    def directions(array: PlanarArray, channel: Tensor, frequency_hz: Tensor | None) -> Tensor:
        return esprit(array, channel)


@ESTIMATORS.register("maximum_likelihood")
class MaximumLikelihood(SnapshotEstimator):
    """The direction of one source by maximum likelihood."""

    @staticmethod
    def directions(array: PlanarArray, channel: Tensor, frequency_hz: Tensor | None) -> Tensor:
        return maximum_likelihood(array, channel)


@ESTIMATORS.register("joint_music")
class JointMusic(SnapshotEstimator):
    """The direction of the earliest path by MUSIC over elements and subcarriers."""

    @staticmethod
    def directions(array: PlanarArray, channel: Tensor, frequency_hz: Tensor | None) -> Tensor:
        if frequency_hz is None:
            raise InputError("delays of paths need subcarriers; these are snapshots without frequencies")
        return joint_music(array, channel, frequency_hz)
