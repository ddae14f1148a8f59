"""How strong each path is where: furniture hides image sources from parts of a room, surfaces end, and walls are no perfect
mirrors.

The direct wave and those of the image sources keep their directions and lengths; their amplitudes are smooth functions of
the position s of the moving end,

    h_k(s) = sum_i a_i(s) exp(-j k d_i + j phi_k(u_i)) / d_i,    a_i(s) = gain_i + f_i(s) + j g_i(s),

with d_i, u_i length and direction of path i, phi_k the phase it gains at element k, and f_i, g_i Gaussian processes:
primitives anchored to the image sources, of which geometry tells everything but the amplitude. Spectra tell phases only, so
several fields explain the training spectra equally well, and the mean of their spectra is closer to a new one than any of
theirs. Each is a maximum a posteriori around a draw from the prior (randomised maximum likelihood, D. S. Oliver, N. He and
A. C. Reynolds, "Conditioning permeability fields to pressure data", ECMOR 1996), of all training positions at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from swiftwrf.gp import GaussianProcess, Kernel
from swiftwrf.models.geometry.images import Scene, image_gain, images, visibility
from swiftwrf.models.geometry.model import GeometryModel

DEVIATION = torch.tensor([0.6, 0.3])  # of an amplitude from its plane's gain, in phase and in quadrature
PART = 4  # of the region's extent, over which amplitudes are alike
MISFIT = 0.05  # twice the coherence that a spectrum may well miss
NUGGET = 1e-3  # variance of an amplitude that is no function of position
FIELDS = 8  # whose spectra are averaged
DRAWN = 0.5  # of the prior's deviation: draws of the whole explain held-out spectra worse
STEPS, RATE = 30, 0.2  # of Adam, on standard normal variables


@dataclass(frozen=True, eq=False)
class PathGains:
    """Amplitudes of the direct path and of each image as functions of position, in several equally plausible fields.

    Args:
        kernel: how alike an amplitude is at two positions, lengths in [m].
        anchor: training positions, float64 (n, 3) [m].
        readout: kernel weights to what each amplitude differs from its gain by, real and imaginary part, float32
            (n, F, 1 + S, 2).
    """

    kernel: Kernel
    anchor: Tensor
    readout: Tensor

    @cached_property
    def _process(self) -> GaussianProcess:
        return GaussianProcess(self.kernel, self.anchor)

    def channel(self, geometry: GeometryModel, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """What each element hears in each field at positions (n, 3) [m], complex64 (n, F, K), as if in as many snapshots;
        with a generator in one of the fields, whose amplitudes are drawn as if those at the training positions were known,
        (n, 1, K)."""
        change = self.kernel(position.double(), self.anchor).float() @ self.readout.flatten(1)
        change = change.reshape(-1, *self.readout.shape[1:])
        if generator is not None:
            field = torch.randint(change.shape[1], (len(change),), generator=generator)
            change = change[torch.arange(len(change)), field, None]
            spread = self._process.variance(position).sqrt().float()[:, None, None, None] * DEVIATION
            change = change + spread * torch.randn(change.shape, generator=generator)
        wave, gain = paths(geometry, geometry.scene(position))
        return (gain + torch.view_as_complex(change)) @ wave


def paths(geometry: GeometryModel, scene: Scene) -> tuple[Tensor, Tensor]:
    """What the elements would hear of the direct path and of each image alone, complex64 (n, 1 + S, K), and their gains,
    (1 + S,)."""
    room = geometry.tensors()
    sequence = room.sequence
    wave, strength = [scene.wave(scene.transmitter)[None]], [torch.ones(1)]
    if sequence:
        source = images(scene, room.normal, room.offset, sequence)
        reflected = scene.wave(source) * visibility(scene, room.normal, room.offset, sequence)[..., None]
        wave.append(reflected[0])
        strength.append(image_gain(room.gain, sequence)[0])
    return torch.cat([part.expand(-1, len(scene), -1) for part in wave]).transpose(0, 1), torch.cat(strength)


@torch.enable_grad()
def fit_path_gains(geometry: GeometryModel, scene: Scene, kernel: Kernel) -> PathGains:
    """The most plausible amplitudes around several draws, given the phases that the scene observed."""
    wave, gain = paths(geometry, scene)
    anchor = scene.moving.double()
    root = torch.linalg.cholesky(kernel.noisy_gram(anchor))
    smooth = root.float()
    draw = DRAWN * torch.randn(len(scene), FIELDS, len(gain), 2, generator=torch.Generator().manual_seed(0))
    normal = draw.clone().requires_grad_()
    optimiser = torch.optim.Adam([normal], lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        change = DEVIATION * (smooth @ normal.flatten(1)).view_as(normal)
        field = (gain + torch.view_as_complex(change)) @ wave
        missing = 1 - scene.coherence(field.transpose(0, 1))
        loss = missing.sum() / MISFIT + (normal - draw).square().sum() / 2
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    weight = torch.linalg.solve_triangular(root.T, normal.detach().flatten(1).double(), upper=True)
    return PathGains(kernel, anchor, DEVIATION * weight.float().view_as(normal))


def prior(position: Tensor) -> Kernel:
    """How alike an amplitude is at two positions of the region of these (n, 3) [m]."""
    extent = float((position.max(0).values - position.min(0).values).max())
    return Kernel(long=extent / PART, short=extent, share=1.0, noise=NUGGET)
