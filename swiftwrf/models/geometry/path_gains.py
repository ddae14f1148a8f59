"""Position-dependent path gains: furniture and the ends of surfaces hide image sources from parts of a room.

Direct path and image sources keep their directions and lengths. Their gains are smooth functions of the position s,

    h_k(s) = sum_i a_i(s) exp(-j k d_i + j phi_k(u_i)) / d_i,    a_i(s) = gain_i + f_i(s) + j g_i(s),

with length d_i and direction u_i of path i, its phase phi_k at element k, and Gaussian processes f_i, g_i. Spectra determine
phases only, so several fields explain the training spectra equally well, and the mean of their spectra predicts better than
any of them. Each field is a maximum a posteriori around a sample of the prior (randomised maximum likelihood, D. S. Oliver,
N. He and A. C. Reynolds, "Conditioning permeability fields to pressure data", ECMOR 1996). How wide the prior is, and how
closely a field follows the phases, is chosen on held-out spectra.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from scipy.linalg.blas import strmm
from torch import Tensor

from swiftwrf.data.splits import each_fold
from swiftwrf.errors import InputError
from swiftwrf.gp import GaussianProcess, Kernel
from swiftwrf.models.geometry.channels import waves
from swiftwrf.models.geometry.images import LinkAt, PhaseObservations
from swiftwrf.models.geometry.model import GeometryModel
from swiftwrf.models.geometry.phase_retrieval import autocorrelation
from swiftwrf.models.geometry.planes import advantage
from swiftwrf.runtime.threads import parallel_map, single_thread
from swiftwrf.runtime.validation import PositiveInt

MAX_CHOICE = 200  # spectra that choose the prior
MIN_ERROR = 1e-6  # of squared co-array numbers, by rounding
MAX_PATHS = 100  # of a room with image sources of a higher order, whose time grows with their number

PriorName = Literal["loose", "tight"]


@dataclass(frozen=True)
class GainPrior:
    """Prior of path gains, and how closely a fit follows the observed phases.

    Args:
        std: Standard deviation of a gain about that of its planes, in phase and in quadrature.
        sample_std: Standard deviation of the samples around which fields are fitted, relative to the prior. Samples of the
            whole prior explain held-out spectra worse.
        missing_scale: Scale s of the misfit: a spectrum adds (1 - coherence) / s to the negative log posterior.
        steps: Number of Adam steps.
    """

    std: tuple[float, float]
    sample_std: float
    missing_scale: float
    steps: int


# Loose where many paths are unknown, tight where the image sources explain nearly all of the field.
PRIORS: dict[PriorName, GainPrior] = {
    "loose": GainPrior(std=(0.6, 0.3), sample_std=0.5, missing_scale=0.05, steps=30),
    "tight": GainPrior(std=(0.3, 0.3), sample_std=0.25, missing_scale=0.02, steps=120),
}


@dataclass(frozen=True, eq=False)
class PathGains:
    """Gains of the direct path and of each image as functions of position, in F equally plausible fields.

    Args:
        process: Process of the differences of each gain from that of its planes, real and imaginary part, float32
            (n, F * S * 2).
        n_paths: Number of paths S, the direct one included.
        prior: Name of the prior.

    Raises:
        InputError: Coefficients that do not fit the number of paths.
    """

    process: GaussianProcess
    n_paths: PositiveInt
    prior: PriorName = "loose"

    def __post_init__(self) -> None:
        if (size := self.process.value.shape[1]) == 0 or size % (2 * self.n_paths):
            raise InputError(
                f"path gains of {self.n_paths} paths need multiples of {2 * self.n_paths} coefficients, got {size}"
            )

    def averaged(self) -> PathGains:
        """Return the mean of the fields, as one field."""
        value = self.process.value.unflatten(1, (-1, 2 * self.n_paths)).mean(dim=1)
        process = GaussianProcess(self.process.kernel, self.process.known, value, exact=True)
        return PathGains(process, self.n_paths, self.prior)

    def channel(self, geometry: GeometryModel, position: Tensor) -> Tensor:
        """Return the channel of each element in each of F fields at positions (n, 3) [m], complex64 (n, F, K)."""
        wave, gain = paths(geometry, geometry.link_at(position))
        return (gain[:, None] + self.change(position)) @ wave

    def change(self, position: Tensor) -> Tensor:
        """Return the differences of the gains from those of the planes in each field, complex64 (n, F, S)."""
        change = self.process.mean(position).unflatten(1, (-1, self.n_paths, 2))
        return torch.view_as_complex(change)


def paths(geometry: GeometryModel, scene: LinkAt) -> tuple[Tensor, Tensor]:
    """Return the waves of the direct path and of each image, complex64 (n, 1 + S, K), and their gains, (n, 1 + S)."""
    wave = waves(geometry.reflectors, scene, torch.ones(1))[:, :, 0]
    return wave, geometry.gains(scene)


@single_thread()
def fit_path_gains(
    geometry: GeometryModel, scene: PhaseObservations, kernel: Kernel, name: PriorName = "loose"
) -> PathGains:
    """Fit path gains around several samples of their prior to the observed phases."""
    prior, (wave, gain) = PRIORS[name], paths(geometry, scene)
    factor = torch.linalg.cholesky(kernel.covariance(scene.moving.double())).float()
    shape = len(scene), 8, gain.shape[1], 2  # eight fields, whose spectra are averaged
    sample = prior.sample_std * torch.randn(shape, generator=torch.Generator().manual_seed(0))
    gradient, normal = posterior_gradient(scene, wave, gain, factor, sample, prior), sample.clone()
    optimiser = torch.optim.Adam([normal], lr=0.2, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, prior.steps)
    for _ in range(prior.steps):
        normal.grad = gradient(normal)
        optimiser.step()
        schedule.step()
    value = factor @ (torch.tensor(prior.std) * normal).flatten(1)
    return PathGains(GaussianProcess(kernel, scene.moving.double(), value, exact=True), normal.shape[2], name)


def posterior_gradient(
    scene: PhaseObservations, wave: Tensor, gain: Tensor, factor: Tensor, sample: Tensor, prior: GainPrior
) -> Callable[[Tensor], Tensor]:
    """Return the gradient of the negative logarithm of the posterior density of path gains, around samples of the prior.

    Gains are a_i = gain_i + std (factor @ z)_i with standard normal variables z (n, F, S, 2). Up to a constant it is

        sum_s (1 - c_s) / missing_scale + |z - sample|^2 / 2,    c_s = max_x |sum_k conj(x_sk) u_sk|^2 / K^2,

    with the phases u = h / |h| of the field h = a w and both observed alternatives x. Its gradient is written out, because
    automatic differentiation takes twice as long. It follows from du_k = j u_k Im(conj(u_k) dh_k) / |h_k|.

    Args:
        scene: Observed phases at n positions.
        wave: Waves of the paths, complex64 (n, S, K).
        gain: Gains of the paths (n, S) without those differences.
        factor: Cholesky factor of the kernel matrix, lower triangle, (n, n).
        sample: Samples of the prior (n, F, S, 2).
        prior: Prior of the gains.
    """
    without, conjugate = gain.to(wave.dtype)[:, None] @ wave, scene.channel.conj().resolve_conj()
    std = torch.tensor(prior.std).expand(sample.shape[1:]).contiguous()
    scale = 2 / (prior.missing_scale * wave.shape[-1] ** 2)

    def times_factor(values: Tensor, transposed: bool = False) -> Tensor:  # half the operations of a full matrix
        product = strmm(1.0, factor.numpy().T, values.flatten(1).numpy().T, side=1, trans_a=transposed)
        return torch.from_numpy(product.T).view_as(values)

    def gradient(normal: Tensor) -> Tensor:
        field = without + torch.view_as_complex(std * times_factor(normal)) @ wave
        unit = field.sgn()
        match = unit @ conjugate.mT
        better = match.abs().argmax(-1, keepdim=True)
        nearer = conjugate.gather(1, better.expand(-1, -1, field.shape[-1]))
        across = (match.gather(2, better).conj() * nearer * unit).imag
        slope = scale * across / field.abs().clamp_min_(1e-30)  # a phase needs no modulus
        by_gain = torch.complex(-slope * unit.imag, slope * unit.real) @ wave.mH
        return times_factor(std * torch.view_as_real(by_gain), transposed=True) + (normal - sample)

    return gradient


@single_thread()
def choose_prior(
    geometry: GeometryModel, scene: PhaseObservations, fold: Tensor, *, highest_order: int = 3, behind: float = 3.0
) -> tuple[GeometryModel, PriorName, dict[int, PathGains]]:
    """Choose the order of the image sources and the prior that predict held-out spectra best.

    Args:
        geometry: Room with planes.
        scene: Observed phases at n positions, of which at most 200 are used.
        fold: Fold of each position, (n,).
        highest_order: Order of the image sources that are tried besides those of the room. Not studied.
        behind: Standard errors behind the best candidate at which one is given up before all folds. Not studied.

    Returns:
        Room, perhaps with image sources of a higher order; the name of the prior; and the path gains fitted without each
        fold, by its number, none if not all positions were used.
    """
    complete = len(scene) <= MAX_CHOICE
    some = scene.few_rows(MAX_CHOICE)
    scene, fold = scene.subset(some), fold[some]
    kernel = kernel_of(scene.moving)
    candidates: list[tuple[GeometryModel, PriorName]] = [(geometry, name) for name in PRIORS]
    further = geometry.with_order(highest_order)
    if geometry.order < highest_order and len(further.reflectors.sequence) < MAX_PATHS:
        candidates.append((further, "tight"))
    error: list[list[Tensor]] = [[] for _ in candidates]
    fits: list[dict[int, PathGains]] = [{} for _ in candidates]
    left = list(range(len(candidates)))
    for out, rows in each_fold(fold):
        kept, held = scene.subset(rows), scene.subset(out)

        def fitted(row: int, kept: PhaseObservations = kept) -> PathGains:
            room, name = candidates[row]
            return fit_path_gains(room, kept, kernel, name)

        for row, gains in zip(left, parallel_map(fitted, left), strict=True):
            fits[row][int(fold[out[0]])] = gains
            error[row].append(_error(gains, candidates[row][0], held))
        so_far = {row: torch.cat(error[row]) for row in left}
        best = min(left, key=lambda row: float(so_far[row].mean()))
        # one held-out position has no standard error, and gives nothing up
        left = [row for row in left if row == best or not advantage(so_far[row], so_far[best]) >= behind]
        if len(left) == 1:
            break
    return *candidates[best], fits[best] if complete else {}


def _error(gains: PathGains, geometry: GeometryModel, held: PhaseObservations) -> Tensor:
    """Return the logarithm of the squared error of the co-array numbers at held-out positions."""
    predicted = gains.channel(geometry, held.moving).sgn()
    mean = autocorrelation(predicted, geometry.array).mean(dim=1)
    missed = mean - autocorrelation(held.channel[:, 0], geometry.array)
    return (missed.abs().square().sum(dim=1) + MIN_ERROR).log()


def kernel_of(position: Tensor) -> Kernel:
    """Return the prior kernel of path gains in the region of positions (n, 3) [m]."""
    extent = float((position.max(0).values - position.min(0).values).max())
    return Kernel(extent / 4, matern12_weight=1.0, noise=1e-3)
