"""What a planar array can report at all: the linear space of its squared spectra, and a model that lives in it.

    |S(k)|^2 = sum over element differences l of r(l) exp(j 2 pi l . k / wavelength),    r(-l) = conj(r(l))

The differences form the array's *difference co-array* (Hoctor and Kassam 1990). A 4 x 4 array has 49 of them, so its squared
spectrum is exactly 49 real numbers, at any resolution, at the pole and around the azimuth: a constant and, for each pair
l, -l, a cosine and a sine. Gaussians need neither the array's geometry nor its carrier; this needs both.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, ClassVar, cast

import torch
from torch import Tensor

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.planar import PlanarArray, basis, differences
from swiftwrf.data.spectra import Spectra, check_training, fingerprint
from swiftwrf.data.splits import Validation, folds
from swiftwrf.errors import InputError
from swiftwrf.gp import EXACT, GaussianProcess, Kernel, NearbyProcess, choose_kernel
from swiftwrf.gp.pca import Components, principal_components
from swiftwrf.positions import check_batch, check_drawn, check_positions
from swiftwrf.runtime.checkpoint import Header, Saved, expect, refusing, restore
from swiftwrf.runtime.progress import progress_bar
from swiftwrf.runtime.threads import single_thread

COMPONENTS = 64  # principal components of the training magnitudes that the model keeps at most
LEAST = 1e-6  # share of the variance below which a component is left out
DTYPES = {torch.float64: ("anchor", "readout"), torch.float32: ("offset", "form")}


@lru_cache(maxsize=4)
@torch.inference_mode(False)
def _inverse(array: PlanarArray, grid: AngularGrid) -> Tensor:
    """Squared spectra to coefficients by least squares, float64 (pixels, 1 + 2 P)."""
    inverse: Tensor = torch.linalg.pinv(basis(array, grid))
    return inverse


def project(spectrum: Tensor, array: PlanarArray, grid: AngularGrid, *, stretched: bool = False) -> Tensor:
    """The nearest spectra that the array can produce: least squares on the squares.

    Args:
        spectrum: magnitudes in [0, 1], (n, n_elevation, n_azimuth), from any synthesizer.
        array: with its geometry and carrier.
        grid: of the spectra.
        stretched: each spectrum was stretched to [0, 1] by itself, which took an offset from it; it is found, added for
            the projection and taken off again.

    Returns:
        float32, of the same shape, in [0, 1].

    Raises:
        InputError: spectra of another shape than the grid's.
    """
    if spectrum.dim() != 3 or tuple(spectrum.shape[1:]) != grid.shape:
        raise InputError(
            f"expected spectra of shape (n, {grid.shape[0]}, {grid.shape[1]}), got {tuple(spectrum.shape)}"
        )
    functions, flat = basis(array, grid), spectrum.flatten(1).double()
    inverse = _inverse(array, grid)
    offset = _offset(flat, functions, inverse) if stretched else torch.zeros(len(flat), 1, dtype=torch.float64)
    power = (flat + offset).square() @ inverse @ functions
    projected: Tensor = power.clamp_min(0).sqrt() - offset
    return projected.clamp(0, 1).reshape(spectrum.shape).float()


def _offset(flat: Tensor, functions: Tensor, inverse: Tensor) -> Tensor:
    """What has to be added to each spectrum (n, pixels) so that its square comes closest to the array's space, (n, 1).

    The residual of (s + c)^2 is that of s^2 plus 2 c times that of s: a line in c, whose shortest point is known.
    """
    residual, of_square = (x - x @ inverse @ functions for x in (flat, flat.square()))
    least = -(residual * of_square).sum(1) / (2 * residual.square().sum(1)).clamp_min(torch.finfo(flat.dtype).tiny)
    return least.clamp_min(0)[:, None]


@dataclass(frozen=True, eq=False)
class CoarrayModel(Saved):
    """Spectrum at any position by the array's physics; what `fit_coarray` returns.

    A Gaussian process tells the mean magnitude between the positions; its square, projected, gives the coefficients. The
    coefficients themselves would be the mean of squares, in which strong spectra drown the others (0.2 dB worse in rooms).

    Args:
        array: the antenna array.
        grid: what `synthesize` draws unless told otherwise.
        kernel: of the process, lengths in [m].
        anchor: the training positions, float64 (n, 3) [m].
        readout: kernel weights to K component scores and the offset; these themselves where there are more than 2000
            positions, of which the nearest tell; float64 (n, K + 1).
        offset: the mean of what stretching took from a spectrum, (1,).
        form: scores, with a 1 in front, to coefficients by a quadratic form, (1 + 2 P, K + 1, K + 1).
    """

    kind: ClassVar[str] = "co-array model"

    array: PlanarArray
    grid: AngularGrid
    kernel: Kernel
    anchor: Tensor
    readout: Tensor
    offset: Tensor
    form: Tensor

    @property
    def n_parameters(self) -> int:
        """Numbers that were fitted."""
        return self.readout.numel() + self.form.numel()

    @cached_property
    def process(self) -> GaussianProcess | NearbyProcess:
        """That of the component scores."""
        return (GaussianProcess if len(self.anchor) <= EXACT else NearbyProcess)(self.kernel, self.anchor)

    def coefficients(self, position: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """Of the squared spectrum, (n, 1 + 2 P), and the offset to take off its root, (n, 1); drawn from the posterior at
        each position where there is a generator."""
        if isinstance(self.process, NearbyProcess):
            mean = self.process.mean(position, self.readout)
        else:
            mean = self.kernel(position, self.anchor) @ self.readout
        predicted = mean.float()
        if generator is not None:  # a score's variance is 1 over the number of anchors
            unknown = (self.process.variance(position) / len(self.anchor)).sqrt().float()
            noise = torch.randn(len(position), predicted.shape[1] - 1, generator=generator)
            predicted[:, :-1] += unknown[:, None] * noise
        score = torch.cat([torch.ones_like(predicted[:, :1]), predicted[:, :-1]], dim=1)
        return torch.einsum("nk,ckl,nl->nc", score, self.form, score), self.offset + predicted[:, -1:]

    @torch.no_grad()
    def synthesize(
        self,
        position: Tensor,
        grid: AngularGrid | None = None,
        batch: int = 32,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Spectra at any positions: one matrix product and a root a pixel.

        Args:
            position: of the moving end [m], (n, 3).
            grid: directions to draw; the training spectra's unless given.
            batch: spectra at a time, so many that they stay in the processor's cache.
            generator: draws from the process' posterior at each position instead of taking its mean.

        Returns:
            Magnitudes in [0, 1], float32 (n, n_elevation, n_azimuth).

        Raises:
            InputError: positions of another shape, or not finite; a batch below 1.
        """
        position = check_positions(position)
        check_batch(batch)
        grid = grid or self.grid
        functions = basis(self.array, grid, torch.float32)
        spectrum = torch.empty(len(position), functions.shape[1])
        stretched = bool(self.offset > 0)
        for start in range(0, len(position), batch):
            rows = slice(start, start + batch)
            coefficient, offset = self.coefficients(position[rows], generator)
            drawn = torch.mm(coefficient, functions, out=spectrum[rows])
            drawn.clamp_(min=0).sqrt_()
            if stretched:
                drawn.sub_(offset)
            drawn.clamp_(0, 1)
        return check_drawn(spectrum).reshape(-1, *grid.shape)

    def state(self) -> tuple[dict[str, Tensor], Header]:
        names = ("anchor", "readout", "offset", "form")
        tensors = {name: getattr(self, name) for name in names} | {"element": self.array.element}
        return tensors, {"grid": asdict(self.grid), "kernel": asdict(self.kernel), "wavelength": self.array.wavelength}

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> CoarrayModel:
        array = PlanarArray(tensors["element"], header["wavelength"])
        n, scores = len(tensors["anchor"]), tensors["readout"].shape[-1]
        coefficients = 1 + 2 * len(differences(array))
        shapes = {
            "anchor": (n, 3),
            "readout": (n, scores),
            "offset": (1,),
            "form": (coefficients, scores, scores),
        }
        expect(tensors, shapes)
        double, single = ({name: tensors[name].to(dtype) for name in names} for dtype, names in DTYPES.items())
        return cls(array, AngularGrid(**header["grid"]), Kernel(**header["kernel"]), **double, **single)


def fit_coarray(
    train: Spectra,
    *,
    validation: Validation = "random",
    seed: int = 0,
    checkpoint: Path | None = None,
    on_record: Callable[[dict[str, Any]], None] | None = None,
    progress: bool = True,
) -> CoarrayModel:
    """Fits the model; nothing is optimised step by step.

    Args:
        train: the only spectra it sees, with their array.
        validation: how training spectra are held out to choose the kernel.
        seed: of what is held out.
        checkpoint: a file that keeps the fitted model; where it exists and is of these spectra, it is opened instead.
        on_record: called once, with stage (final), seconds and elapsed, those of the fit also where it is opened.
        progress: show a progress bar on a terminal.

    Raises:
        InputError: no array, fewer than 10 spectra, or something not finite.
    """
    check_training(train)
    if train.array is None:
        raise InputError(f"{train.name} does not say which array took the spectra; give its geometry and carrier")
    owner = fingerprint(train, validation, seed)
    if checkpoint is not None and checkpoint.exists():
        kept, header = restore(checkpoint, CoarrayModel.kind)
        provenance = header.get("provenance")
        if not isinstance(provenance, dict) or provenance.get("fit") != owner:
            raise InputError(
                f"{checkpoint} is of another fit (other spectra or settings); remove it or give another path"
            )
        if on_record is not None:
            with refusing(f"{checkpoint} is no co-array model that was kept by a fit"):
                seconds = float(provenance["seconds"])
            on_record({"stage": "final", "seconds": seconds, "elapsed": seconds})
        return cast(CoarrayModel, kept)
    began = time.perf_counter()
    with progress_bar(progress) as bar:
        bar.add_task("co-array model", total=1)
        model = _solve(train, train.array, folds(train.position, validation, seed))
    seconds = time.perf_counter() - began
    if checkpoint is not None:
        model.save(checkpoint, {"fit": owner, "seconds": repr(seconds)})
    if on_record is not None:
        on_record({"stage": "final", "seconds": seconds, "elapsed": seconds})
    return model


@single_thread()
def _solve(train: Spectra, array: PlanarArray, fold: Tensor) -> CoarrayModel:
    functions = basis(array, train.grid, torch.float32)
    inverse = _inverse(array, train.grid).float()
    parts = list(train.store.parts())
    offset = torch.cat([_offset(train.store[rows].flatten(1), functions, inverse) for rows in parts])

    def batches() -> Iterator[Tensor]:
        return (train.store[rows].flatten(1) + offset[rows] for rows in parts)

    few = len(train) <= EXACT
    if few:
        mean, vector, component = _components(torch.cat(list(batches())))
    else:
        mean, vector, component = principal_components(batches, COMPONENTS, LEAST)
    form = _quadratic_form(torch.cat([mean[None], component]), inverse)

    kernel = choose_kernel(train.position, train.store, fold)
    target = torch.cat([vector, (offset - offset.mean()).double()], dim=1)
    readout = torch.linalg.solve(kernel.noisy_gram(train.position), target) if few else target
    return CoarrayModel(array, train.grid, kernel, train.position, readout, offset.mean()[None], form)


def _components(flat: Tensor) -> Components:
    """Principal components from the rows' inner products, of which there are far fewer than pixels."""
    mean = flat.mean(dim=0)
    value, vector = torch.linalg.eigh(((flat - mean) @ (flat - mean).T).double())
    vector = vector[:, value > LEAST * value.sum()][:, -COMPONENTS:]
    return Components(mean, vector, vector.T.float() @ (flat - mean))


def _quadratic_form(component: Tensor, inverse: Tensor) -> Tensor:
    """Coefficients of the products of all pairs of components (K + 1, pixels), (coefficients, K + 1, K + 1)."""
    n = len(component)
    form = torch.empty(n, n, inverse.shape[1])
    for i in range(n):
        form[i, i:] = (component[i] * component[i:]) @ inverse
        form[i:, i] = form[i, i:].clone()
    return form.permute(2, 0, 1).contiguous()
