"""The room that the spectra show."""

from __future__ import annotations

from collections import OrderedDict

import torch
from torch import Tensor

from augment.synthesizers.base import ARRAY, FIXED_END, SYNTHESIZERS, Settings, Synthesizer
from swiftwrf import GeometryModel, Spectra, fit_geometry
from swiftwrf.data.spectra import fingerprint
from swiftwrf.geometry import refit_geometry

_ROOMS: OrderedDict[str, GeometryModel] = OrderedDict()  # the last ones found: synthesizers that need the same share it
_KEPT = 4


def find_room(train: Spectra, settings: Settings) -> GeometryModel:
    """The room in which these spectra were measured; found once for all synthesizers that build on it."""
    key = fingerprint(train, settings.validation, settings.seed)
    if key not in _ROOMS:
        _ROOMS[key] = fit_geometry(
            train, validation=settings.validation, seed=settings.seed, progress=settings.progress
        )
        if len(_ROOMS) > _KEPT:
            _ROOMS.popitem(last=False)
    return _ROOMS[key]


@SYNTHESIZERS.register(
    "geometry",
    meaning="paths by way of the room's walls, which it finds from the spectra",
    needs=(ARRAY, FIXED_END),
    colour="#0077bb",
)
class Geometry(Synthesizer):
    """Image sources of the known fixed end in mirror planes found from the training spectra."""

    samples = True

    def fit(self, train: Spectra) -> None:
        self._model = find_room(train, self.settings)

    def fit_like(self, other: Synthesizer, train: Spectra) -> None:
        assert isinstance(other, Geometry)
        self._model = refit_geometry(other.model, train, seed=self.settings.seed)

    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._model.synthesize(position, generator)

    @property
    def model(self) -> GeometryModel:
        return self._model
