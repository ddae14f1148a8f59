"""Files that a fitted field model leaves in the run's directory: the model and its room."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from swiftwrf import Spectra
from swiftwrf.models import FieldModel
from swiftwrf.models.neighbours import MemoryModel
from swiftwrf.runtime.durable import write_json, write_npz

N_LAYERS = 3  # of heights between which furniture is shown


def model_file(folder: Path, name: str, key: str) -> Path:
    """Return the file of a run's fitted field model, by its name and the measured fraction in file names."""
    return folder / f"{name}-mix{key}.safetensors"


def save_artifacts(model: FieldModel, key: str, measured: Spectra, test: Spectra, folder: Path) -> None:
    """Save a field model fitted to the measured spectra, and its room. Models that store these spectra are not saved."""
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
