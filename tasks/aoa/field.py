"""The synthesized field as the report shows it: where the strongest signal comes from over the region, and how the
primitives of SwiftWRF change along a walk through it."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from augment.places import draw_positions
from augment.synthesizers import Synthesizer
from swiftwrf import Spectra, SwiftWRF

PLACES = 2000  # at which the strongest direction is looked up: a dense map on half a page
BATCH = 250  # spectra held at a time
STEPS = 120  # of the walk
STRONGEST = 40  # primitives that are followed; the others hardly show


def strongest_direction(synthesizer: Synthesizer, measured: Spectra, seed: int) -> dict[str, NDArray[Any]]:
    """Azimuth and elevation [rad] of the strongest direction, and its magnitude, at places drawn in the region of the
    measured positions, all at their median height."""
    position = draw_positions(measured.position, PLACES, seed)
    position[:, 2] = measured.position[:, 2].median()
    direction: list[Tensor] = []
    magnitude: list[Tensor] = []
    for part in position.split(BATCH):
        spectrum = synthesizer.synthesize(part)
        direction.append(measured.grid.peak_direction(spectrum))
        magnitude.append(spectrum.amax(dim=(1, 2)))
    azimuth, elevation = torch.cat(direction).T.numpy()
    return {
        "position": position.numpy(),
        "azimuth": azimuth,
        "elevation": elevation,
        "magnitude": torch.cat(magnitude).numpy(),
    }


@torch.no_grad()
def motion(model: SwiftWRF, measured: Spectra) -> dict[str, NDArray[Any]]:
    """The strongest primitives along a straight walk through the middle of the region, along its longest extent.

    Returns:
        walk (steps, 3) [m]; mean (steps, n, 2) [rad] and covariance (n, 2, 2) [rad^2] at the first step; strength
        (steps, n), the magnitude of each one's weight.
    """
    walk = _walk(measured.position)
    gaussians = model.gaussians(model.normalise(walk.to(model.centre.device)))
    strength = gaussians.weight.norm(dim=-1).expand(len(walk), -1).cpu()
    mean = gaussians.mean.expand(len(walk), -1, -1).cpu()
    l1, l2, l3 = gaussians.cholesky.expand(len(walk), -1, -1)[0].cpu().unbind(-1)
    factor = torch.stack([torch.stack([l1, torch.zeros_like(l1)], -1), torch.stack([l2, l3], -1)], -2)
    chosen = strength.mean(dim=0).argsort(descending=True)[:STRONGEST]
    return {
        "walk": walk.numpy(),
        "mean": mean[:, chosen].numpy(),
        "covariance": (factor @ factor.mT)[chosen].numpy(),
        "strength": strength[:, chosen].numpy(),
    }


def _walk(known: Tensor) -> Tensor:
    centre = known.mean(dim=0)
    axis = torch.linalg.svd(known - centre, full_matrices=False)[2][0]
    along = (known - centre) @ axis
    ends = along.quantile(torch.tensor([0.05, 0.95], dtype=along.dtype))
    steps = torch.linspace(0, 1, STEPS, dtype=along.dtype)[:, None]
    walk: Tensor = centre + (ends[0] + steps * (ends[1] - ends[0])) * axis
    return walk
