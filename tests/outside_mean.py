"""A field model of another package."""

from typing import Annotated

from torch import Tensor

from swiftwrf.models.base import FieldModel


class Mean(FieldModel):
    """The mean of the training spectra."""

    name = "outside_mean"
    kind = "outside mean"
    saved = "mean"
    mean: Annotated[Tensor, "float32 grid.n_elevation grid.n_azimuth"]

    def _fit(self, train, **_):
        self.mean = train.spectrum.mean(dim=0)

    def _predict(self, position, grid, with_std):
        return self.mean.expand(len(position), -1, -1), None
