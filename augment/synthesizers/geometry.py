"""The room that the spectra show."""

from __future__ import annotations

import time
from collections import OrderedDict

import torch
from torch import Tensor

from augment.synthesizers.base import ARRAY, FIXED_END, SYNTHESIZERS, Settings, Synthesizer
from swiftwrf import GeometryModel, Spectra, fit_geometry
from swiftwrf.data.spectra import fingerprint
from swiftwrf.models.geometry import refit_geometry

_ROOMS: OrderedDict[str, tuple[GeometryModel, float]] = OrderedDict()  # the last ones found, with the seconds that took
_KEPT = 4


def find_room(train: Spectra, settings: Settings) -> tuple[GeometryModel, float]:
    """The room in which these spectra were measured, found once for all synthesizers that build on it, and the seconds
    that another one spent on it."""
    key = fingerprint(train, settings.validation, settings.seed)
    if key in _ROOMS:
        return _ROOMS[key]
    began = time.perf_counter()
    room = fit_geometry(train, validation=settings.validation, seed=settings.seed, progress=settings.progress)
    _ROOMS[key] = room, time.perf_counter() - began
    if len(_ROOMS) > _KEPT:
        _ROOMS.popitem(last=False)
    return room, 0.0


@SYNTHESIZERS.register(
    "geometry",
    meaning="paths by way of the room's walls, which it finds from the spectra",
    needs=(ARRAY, FIXED_END),
    colour="#3366ff",
)
class Geometry(Synthesizer):
    """Image sources of the known fixed end in mirror planes found from the training spectra."""

    samples = True

    def fit(self, train: Spectra) -> None:
        self._model, self.shared_seconds = find_room(train, self.settings)

    def fit_like(self, other: Synthesizer, train: Spectra) -> None:
        assert isinstance(other, Geometry)
        self._model = refit_geometry(other.model, train, seed=self.settings.seed)

    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._model.synthesize(position, generator)

    @property
    def model(self) -> GeometryModel:
        return self._model
