"""Files that a fitted field model leaves in the run's directory: the model, its room, and maps of its spectra."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from augment.positions import sample_positions
from swiftwrf import Spectra, SwiftWRF
from swiftwrf.models import FieldModel
from swiftwrf.models.neighbours import MemoryModel
from swiftwrf.models.swiftwrf_paper import SwiftWRFPaper
from swiftwrf.runtime.durable import write_json, write_npz

MODEL_FILE = "model"  # name of the file of a swiftwrf model; other field models have their own names
N_MAP_POSITIONS = 2000  # positions of the map: dense on half a page
BATCH_SPECTRA = 250  # spectra held at a time
N_WALK_POSITIONS = 120
N_LAYERS = 3  # of heights between which furniture is shown
MAX_PRIMITIVES = 40  # strongest primitives shown along the walk


def model_file(folder: Path, name: str, key: str) -> Path:
    """Return the file of a run's fitted field model.

    Args:
        folder: Directory of the run.
        name: Name of the field model.
        key: Measured fraction in file names.
    """
    return folder / f"{MODEL_FILE if name == SwiftWRF.name else name}-mix{key}.safetensors"


def save_artifacts(model: FieldModel, key: str, measured: Spectra, test: Spectra, folder: Path) -> None:
    """Save a fitted field model, its room, and the data of the maps that the report shows.

    Args:
        model: Field model fitted to `measured`. Models that store the measured spectra are not saved.
        key: Measured fraction in file names.
        measured: Measured spectra.
        test: Test spectra.
        folder: Directory of the run.
    """
    mix = f"mix{key}"
    if not isinstance(model, MemoryModel):
        model.save(model_file(folder, model.name, key))
    if model.room is not None:
        write_json(folder / f"geometry-{mix}.json", model.room.to_json())
        position, gain, order = model.room.image_sources()
        places = {
            "measured": measured.position,
            "test": test.position,
            "fixed": model.room.fixed_position,
            "image": position,
            "gain": gain,
            "order": order,
        }
        arrays = {name: value.numpy() for name, value in places.items()}
        if (furniture := model.room.furniture) is not None:
            top = float(furniture.low[2]) + furniture.voxel_m * furniture.absorption.shape[2]
            height = np.linspace(float(furniture.low[2]), top, N_LAYERS + 1)
            layers = [furniture.in_plan(*ends) for ends in pairwise(height)]
            arrays |= {"height": height, "plan_x": layers[0][0], "plan_y": layers[0][1]}
            arrays["plan"] = np.stack([values for _, _, values in layers])
        write_npz(folder / f"room-{mix}.npz", arrays)
    if not model.slow:
        write_npz(folder / f"field-{model.name}-{mix}.npz", peak_map(model, measured))
    if isinstance(model, SwiftWRF | SwiftWRFPaper):
        write_npz(folder / f"motion-{mix}.npz", deformation(model, measured))


def peak_map(model: FieldModel, measured: Spectra) -> dict[str, NDArray[Any]]:
    """Return the direction [rad] and the magnitude of the spectrum's peak at random positions in the measured region.

    All positions have the median height of the measured ones.
    """
    position = sample_positions(measured.position, N_MAP_POSITIONS, model.config.seed)
    position[:, 2] = measured.position[:, 2].median()
    direction: list[Tensor] = []
    magnitude: list[Tensor] = []
    for part in position.split(BATCH_SPECTRA):
        spectrum = model.synthesize(part).cpu()
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
def deformation(model: SwiftWRF | SwiftWRFPaper, measured: Spectra) -> dict[str, NDArray[Any]]:
    """Return the strongest primitives along a straight walk through the middle of the region, along its longest extent.

    Returns:
        walk (steps, 3) [m]; mean (steps, n, 2) [rad] and covariance (n, 2, 2) [rad^2] at the first step; strength
        (steps, n), the magnitude of each primitive's weight.
    """
    walk = _walk(measured.position)
    mean, cholesky, weight = (tensor.cpu() for tensor in model.primitives(walk))
    strength = weight.norm(dim=-1)
    l1, l2, l3 = cholesky.unbind(-1)
    factor = torch.stack([torch.stack([l1, torch.zeros_like(l1)], -1), torch.stack([l2, l3], -1)], -2)
    chosen = strength.mean(dim=0).argsort(descending=True)[:MAX_PRIMITIVES]
    return {
        "walk": walk.numpy(),
        "mean": mean[:, chosen].numpy(),
        "covariance": (factor @ factor.mT)[chosen].numpy(),
        "strength": strength[:, chosen].numpy(),
    }


def _walk(known: Tensor) -> Tensor:
    """Return positions (steps, 3) [m] on a line through the centre of known positions."""
    centre = known.mean(dim=0)
    axis = torch.linalg.svd(known - centre, full_matrices=False)[2][0]
    along = (known - centre) @ axis
    ends = along.quantile(torch.tensor([0.05, 0.95], dtype=along.dtype))
    steps = torch.linspace(0, 1, N_WALK_POSITIONS, dtype=along.dtype)[:, None]
    walk: Tensor = centre + (ends[0] + steps * (ends[1] - ends[0])) * axis
    return walk
