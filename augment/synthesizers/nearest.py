"""Look-up."""

from __future__ import annotations

import torch
from torch import Tensor

from augment.synthesizers.base import SYNTHESIZERS, Synthesizer
from swiftwrf import Spectra
from swiftwrf.positions import nearest


@SYNTHESIZERS.register("nearest", meaning="the spectrum of the nearest measured position", colour="#ccbb44")
class Nearest(Synthesizer):
    """The spectrum of the nearest measured position: the baseline that a dense path makes hard to beat."""

    def fit(self, train: Spectra) -> None:
        self._train = train

    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._train.store[nearest(position, self._train.position, 1)[1][:, 0]]
