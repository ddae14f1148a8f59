"""A field model of another package."""

from swiftwrf.models.base import FieldModel
from swiftwrf.runtime.checkpoint import expect


class Mean(FieldModel):
    """The mean of the training spectra."""

    name = "outside_mean"
    kind = "outside mean"

    def _fit(self, train, **_):
        self.mean = train.spectrum.mean(dim=0)

    def _predict(self, position, grid, with_std):
        return self.mean.expand(len(position), -1, -1), None

    def _state(self):
        return {"mean": self.mean}, {}

    def _restore(self, tensors, header):
        expect(tensors, {"mean": self.grid.shape})
        self.mean = tensors["mean"]
