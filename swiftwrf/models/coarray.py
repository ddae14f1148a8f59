"""The linear space of the squared spectra of a planar array, and a model in it.

    |S(k)|^2 = sum over element differences l of r(l) exp(j 2 pi l . k / wavelength),    r(-l) = conj(r(l))

The differences form the array's *difference co-array* (Hoctor and Kassam 1990). A 4 x 4 array has 49 of them, so its squared
spectrum is exactly 49 real coefficients at any resolution: a constant and, for each pair l, -l, a cosine and a sine.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Annotated, Any

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.planar import PlanarArray, basis, differences
from swiftwrf.data.spectra import Spectra, coarsening
from swiftwrf.data.splits import folds
from swiftwrf.data.store import Store
from swiftwrf.errors import InputError
from swiftwrf.gp import GaussianProcess, choose_kernel, principal_components
from swiftwrf.models.base import ARRAY
from swiftwrf.models.link import Linked
from swiftwrf.models.process import ProcessModel
from swiftwrf.runtime.threads import single_thread

MAX_COMPONENTS = 64  # principal components of the training magnitudes
MAX_EXACT_ROWS = 2000  # spectra whose principal components are computed in memory


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


class CoarrayModel(Linked, ProcessModel):
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

    process: GaussianProcess
    """process of the K component scores and the offset"""
    saved = "offset form component"
    offset: Annotated[Tensor, "float32 1"]
    """mean offset that stretching removed from a spectrum"""
    form: Annotated[Tensor, "float32 c process.k process.k"]
    """quadratic form from K scores, after a 1, to coefficients, (1 + 2 P, K + 1, K + 1)"""
    component: Annotated[Tensor, "float32 process.k h w"]
    """mean magnitude and its components, averaged to few pixels, (1 + K, h, w)"""

    @single_thread()
    def _fit(self, train: Spectra, **_: Any) -> None:
        array = self.array
        functions = basis(array, train.grid, torch.float32)
        inverse = _inverse(array, train.grid).float()
        parts = list(train.store.parts())
        offset = torch.cat([_offset(train.store[rows].flatten(1), functions, inverse) for rows in parts])

        def batches() -> Iterator[Tensor]:
            return (train.store[rows].flatten(1) + offset[rows] for rows in parts)

        few = len(train) <= MAX_EXACT_ROWS
        mean, score, component = principal_components(torch.cat(list(batches())) if few else batches, MAX_COMPONENTS)
        basis_magnitude = torch.cat([mean[None], component])
        self.form = _quadratic_form(basis_magnitude, inverse)
        self.component = _coarse(Store(basis_magnitude.unflatten(1, train.grid.shape)))
        fold = folds(train.position, self.config.validation, self.config.seed)
        kernel = choose_kernel(train.position, train.store, fold)
        target = torch.cat([score, (offset - offset.mean()).double()], dim=1)
        self.process = GaussianProcess(kernel, train.position, target)
        self.offset = offset.mean()[None]
        value = self.process.value
        self._set_spread(train, fold, lambda rows: value[rows], lambda score, _: self._spectra(score, self.grid))

    def _values(self, new: Spectra) -> Tensor:
        functions, inverse = basis(self.array, self.grid, torch.float32), _inverse(self.array, self.grid).float()
        spectrum = new.store[:]
        offset = _offset(spectrum.flatten(1), functions, inverse)
        component = self.component[1:].flatten(1).double()
        change = (_coarse(Store(spectrum + offset[..., None])) - self.component[0]).flatten(1).double()
        score = torch.linalg.solve(component @ component.T, component @ change.T).T
        return torch.cat([score, (offset - self.offset).double()], dim=1)

    def _weighted_values(self) -> Tensor:
        weighted: Tensor = self.process.value[:, :-1] * self.component[1:].flatten(1).norm(dim=1)
        return weighted

    def _spectra(self, score: Tensor, grid: AngularGrid) -> Tensor:
        """Return the spectra (b, H, W) of component scores with an offset (b, K + 1)."""
        one = torch.cat([torch.ones_like(score[:, :1]), score[:, :-1]], dim=1)
        coefficient = torch.einsum("nk,ckl,nl->nc", one, self.form, one)
        spectrum = (coefficient @ basis(self.array, grid, torch.float32)).clamp_(min=0).sqrt_()
        if bool(self.offset > 0):
            spectrum = spectrum - (self.offset + score[:, -1:])
        return spectrum.reshape(-1, *grid.shape)

    def _predict(self, position: Tensor, grid: AngularGrid, with_std: bool) -> tuple[Tensor, Tensor | None]:
        mean = self._spectra(self.process.mean(position).float(), grid)
        return mean, self._std(position, grid) if with_std else None

    def _restored(self) -> None:
        super()._restored()
        shape = 1 + 2 * len(differences(self.array)), *_coarse(Store(torch.zeros(1, *self.grid.shape))).shape[1:]
        if (len(self.form), *self.component.shape[1:]) != shape:
            raise InputError(f"the array and grid have {shape[0]} coefficients and components of {shape[1:]} pixels")


def _coarse(spectra: Store) -> Tensor:
    """Return spectra averaged to few pixels, (n, h, w)."""
    factor = coarsening(spectra.shape[1:], 90)  # the beams of an array are far wider
    return spectra.coarsen(factor)[:]


def _quadratic_form(component: Tensor, inverse: Tensor) -> Tensor:
    """Return the coefficients of the products of all pairs of components (K + 1, pixels), (1 + 2 P, K + 1, K + 1)."""
    n = len(component)
    form = torch.empty(n, n, inverse.shape[1])
    for i in range(n):
        form[i, i:] = (component[i] * component[i:]) @ inverse
        form[i:, i] = form[i, i:].clone()
    return form.permute(2, 0, 1).contiguous()
