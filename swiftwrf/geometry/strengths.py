"""How strong each path is where: furniture hides image sources from parts of a room, and surfaces end.

The direct wave and those of the image sources keep their directions and phases; their amplitudes are smooth functions of
the position s of the moving end,

    h_k(s) = sum_i a_i(s) exp(-j k d_i + j phi_k(u_i)) / d_i,    a_i(s) = gain_i + DEVIATION f_i(s),

with d_i, u_i length and direction of path i, phi_k the phase it gains at element k, and f_i a Gaussian process: primitives
anchored to the image sources, of which geometry tells everything but the amplitude. Spectra tell phases only, so the
amplitudes are a maximum a posteriori, of all training positions at once.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from swiftwrf.geometry.images import Scene, image_gain, images, sequences, visibility
from swiftwrf.geometry.model import GeometryModel
from swiftwrf.geometry.planes import clearly
from swiftwrf.gp import GaussianProcess, Kernel

DEVIATION = 0.6  # of an amplitude from its plane's gain
LENGTHS = (2, 4, 8)  # parts of the region over which amplitudes are alike
MISFITS = (0.3, 1.0)  # twice the coherence that a spectrum may well miss
NUGGET = 1e-3  # variance of an amplitude that is no function of position
STEPS, RATE = 80, 0.1  # of Adam, on standard normal variables
LEAST = 100  # positions; fewer do not tell where a shadow ends
NEEDED = 1.5  # standard errors by which held-out spectra must be better; hybrid judges once more


@dataclass(frozen=True)
class Smoothness:
    """The prior of the amplitudes.

    Args:
        kernel: how alike they are at two positions, lengths in [m].
        misfit: of a spectrum, by which its coherence may miss 1.
    """

    kernel: Kernel
    misfit: float


@dataclass(frozen=True, eq=False)
class Strengths:
    """Amplitudes of the direct path and of each image as functions of position.

    Args:
        smoothness: their prior.
        anchor: training positions, float64 (n, 3) [m].
        readout: kernel weights to what each amplitude differs from its gain by, float32 (n, 1 + S).
    """

    smoothness: Smoothness
    anchor: Tensor
    readout: Tensor

    @cached_property
    def _process(self) -> GaussianProcess:
        return GaussianProcess(self.smoothness.kernel, self.anchor)

    def channel(self, geometry: GeometryModel, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """What each element hears at positions (n, 3) [m], complex64 (n, K); with a generator amplitudes are drawn as if
        those at the training positions were known."""
        change = self.smoothness.kernel(position.double(), self.anchor).float() @ self.readout
        if generator is not None:
            spread = DEVIATION * self._process.variance(position).sqrt().float()
            change = change + spread[:, None] * torch.randn(change.shape, generator=generator)
        wave, gain = paths(geometry, geometry.scene(position))
        return _sum(gain + change, wave)


def paths(geometry: GeometryModel, scene: Scene) -> tuple[Tensor, Tensor]:
    """What the elements would hear of the direct path and of each image alone, complex64 (n, 1 + S, K), and their gains,
    (1 + S,)."""
    normal, offset, gain = geometry.tensors()
    sequence = sequences(normal[0], geometry.order)
    wave, strength = [scene.wave(scene.transmitter)[None]], [torch.ones(1)]
    if sequence:
        source = images(scene, normal, offset, sequence)
        reflected = scene.wave(source) * visibility(scene, normal, offset, sequence)[..., None]
        wave.append(reflected[0])
        strength.append(image_gain(gain, sequence)[0])
    return torch.cat([part.expand(-1, len(scene), -1) for part in wave]).transpose(0, 1), torch.cat(strength)


@torch.enable_grad()
def fit_strengths(geometry: GeometryModel, scene: Scene, smoothness: Smoothness) -> Strengths:
    """The most plausible amplitudes, given the phases that the scene observed."""
    wave, gain = paths(geometry, scene)
    anchor = scene.moving.double()
    root = torch.linalg.cholesky(smoothness.kernel.noisy_gram(anchor))
    spread, normal = DEVIATION * root.float(), torch.zeros(len(scene), len(gain), requires_grad=True)
    optimiser = torch.optim.Adam([normal], lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        missing = 1 - scene.coherence(_sum(gain + spread @ normal, wave))
        loss = missing.sum() / smoothness.misfit + normal.square().sum() / 2
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    readout = DEVIATION * torch.linalg.solve_triangular(root.T, normal.detach().double(), upper=True)
    return Strengths(smoothness, anchor, readout.float())


def may_vary(geometry: GeometryModel, positions: int) -> bool:
    """Whether so many training positions could tell that strengths vary."""
    return bool(geometry.planes) and positions >= LEAST


def choose_smoothness(geometry: GeometryModel, splits: list[tuple[Scene, Scene]]) -> Smoothness | None:
    """The prior under which held-out spectra are explained best, None where constant amplitudes do as well.

    Args:
        splits: kept and held-out positions.
    """
    constant = torch.cat([held.coherence(geometry.channel(held.moving)) for _, held in splits])
    best, most = None, constant
    for smoothness in _candidates(torch.cat([scene.moving for scene in splits[0]])):
        found = [
            held.coherence(fit_strengths(geometry, kept, smoothness).channel(geometry, held.moving))
            for kept, held in splits
        ]
        if float(torch.cat(found).mean()) > float(most.mean()):
            best, most = smoothness, torch.cat(found)
    return best if clearly(most, constant) > NEEDED else None


def _candidates(position: Tensor) -> Iterator[Smoothness]:
    extent = float((position.max(0).values - position.min(0).values).max())
    for part, misfit in itertools.product(LENGTHS, MISFITS):
        yield Smoothness(Kernel(long=extent / part, short=extent, share=1.0, noise=NUGGET), misfit)


def _sum(amplitude: Tensor, wave: Tensor) -> Tensor:
    """Of the paths: amplitudes (n, P), waves (n, P, K) to (n, K)."""
    parts = torch.view_as_real(wave).flatten(2)  # amplitudes are real, which saves half of the products
    return torch.view_as_complex((amplitude[:, None] @ parts).reshape(len(wave), -1, 2))
