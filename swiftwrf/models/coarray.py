"""The linear space of the squared spectra of a planar array, and a model in it.

    |S(k)|^2 = sum over element differences l of r(l) exp(j 2 pi l . k / wavelength),    r(-l) = conj(r(l))

The differences form the array's *difference co-array* (Hoctor and Kassam 1990). A 4 x 4 array has 49 of them, so its squared
spectrum is exactly 49 real coefficients at any resolution: a constant and, for each pair l, -l, a cosine and a sine.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any

import torch
from torch import Tensor
from torch.nn import functional

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.planar import PlanarArray, basis, differences
from swiftwrf.data.spectra import Spectra, coarsening
from swiftwrf.data.splits import folds
from swiftwrf.data.store import Store
from swiftwrf.errors import InputError
from swiftwrf.models.base import ARRAY
from swiftwrf.models.interpolator import Interpolator
from swiftwrf.models.link import Linked
from swiftwrf.runtime.threads import single_thread


@lru_cache(maxsize=4)
@torch.inference_mode(False)
def _inverse(array: PlanarArray, grid: AngularGrid) -> Tensor:
    """Return the matrix from squared spectra to coefficients by least squares, float64 (pixels, 1 + 2 P)."""
    inverse: Tensor = torch.linalg.pinv(basis(array, grid))
    return inverse


def _offset(flat: Tensor, functions: Tensor, inverse: Tensor) -> Tensor:
    """Return the offset (n, 1) that brings the square of each spectrum (n, pixels) closest to the array's space.

    The residual of (s + c)^2 is that of s^2 plus 2 c times that of s, linear in c.
    """
    residual, of_square = (x - x @ inverse @ functions for x in (flat, flat.square()))
    least = -(residual * of_square).sum(1) / (2 * residual.square().sum(1)).clamp_min(torch.finfo(flat.dtype).tiny)
    return least.clamp_min(0)[:, None]


class CoarrayModel(Linked, Interpolator):
    """A Gaussian process in the linear space of the squared spectra that the array can produce.

    The process predicts the mean magnitude between the positions; its square, projected, gives the co-array coefficients. A
    process on the coefficients themselves would predict the mean of squares, in which strong spectra dominate.

    Example:
        >>> import swiftwrf
        >>> train, test = swiftwrf.simulated_room(n=50).split()
        >>> model = CoarrayModel().fit(train)
        >>> model.predict(test.position, swiftwrf.AngularGrid.hemisphere(45, 180)).mean.shape
        torch.Size([10, 45, 180])
    """

    name = "coarray"
    kind = "co-array model"
    requires = (ARRAY,)
    any_grid = True
    batch = 32  # spectra that stay in the processor's cache
    grows = False
    max_components = 64  # the time of a prediction grows with their square

    saved = "offset form"
    offset: Annotated[Tensor, "float32 1+process.k"]
    """offset that stretching removed from the mean spectrum, then its change with each component"""
    form: Annotated[Tensor, "float32 c 1+process.k 1+process.k"]
    """quadratic form from K scores, after a 1, to coefficients, (1 + 2 P, 1 + K, 1 + K)"""

    @single_thread()
    def _fit(self, train: Spectra, **_: Any) -> None:
        fold = folds(train.position, self.config.validation, self.config.seed)
        component = self._fit_process(train.position, train.store, fold)
        functions, inverse = basis(self.array, train.grid, torch.float32), _inverse(self.array, train.grid).float()
        offset = torch.cat([_offset(part.flatten(1), functions, inverse) for part in train.store.batches()])
        score = functional.pad(self.process.value.float(), (1, 0), value=1.0)
        self.offset = torch.linalg.lstsq(score, offset, driver="gelsd").solution[:, 0]
        self.form = _quadratic_form(component.flatten(1) + self.offset[:, None], inverse)
        self.component = Store(component).coarsen(coarsening(train.grid.shape, 90))[:]  # beams are far wider
        self._fit_spread(train, fold)

    def _decode(self, score: Tensor, grid: AngularGrid) -> Tensor:
        one = functional.pad(score, (1, 0), value=1.0)
        coefficient = torch.einsum("nk,ckl,nl->nc", one, self.form, one)
        spectrum = (coefficient @ basis(self.array, grid, torch.float32)).clamp_(min=0).sqrt_()
        return (spectrum - (one @ self.offset)[:, None]).reshape(-1, *grid.shape)

    def _restored(self) -> None:
        super()._restored()
        if len(self.form) != (count := 1 + 2 * len(differences(self.array))):
            raise InputError(f"the array has {count} coefficients, the file {len(self.form)}")


def _quadratic_form(component: Tensor, inverse: Tensor) -> Tensor:
    """Return the coefficients of the products of all pairs of components (K + 1, pixels), (1 + 2 P, K + 1, K + 1)."""
    n = len(component)
    form = torch.empty(n, n, inverse.shape[1])
    for i in range(n):
        form[i, i:] = (component[i] * component[i:]) @ inverse
        form[i:, i] = form[i, i:].clone()
    return form.permute(2, 0, 1).contiguous()
