"""Files that turbo learning leaves for its report: field models, their rooms, examples of spectra and of positions."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from swiftwrf import Spectra
from swiftwrf.data.store import Store
from swiftwrf.locate import MatchedField
from swiftwrf.metrics import LEVEL, covered
from swiftwrf.models import FieldModel
from swiftwrf.models.neighbours import MemoryModel
from swiftwrf.runtime.durable import write_json, write_npz

# of the PSNR at the test positions, and of the position error: from the best spectrum to the worst
SPECTRA_QUANTILES, LOCATED_QUANTILES = (1.0, 0.5, 0.0), (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
MAX_CANDIDATES = 300  # candidate positions of largest mass that are stored of an example
N_LAYERS = 3  # of heights between which furniture is shown


def model_file(folder: Path, name: str, key: str) -> Path:
    """Return the file of a fitted model or estimator, by its name and the measured fraction in file names."""
    return folder / f"{name}-mix{key}.safetensors"


def save_model(model: FieldModel, key: str, measured: Spectra, folder: Path) -> None:
    """Save a field model fitted to the measured spectra, and its room. Models that store these spectra are not saved."""
    mix = f"mix{key}"
    if not isinstance(model, MemoryModel):
        model.save(model_file(folder, model.name, key))
    if model.room is not None:
        write_json(folder / f"geometry-{mix}.json", model.room.to_json())
        position, _, order = model.room.image_sources()
        places = {
            "measured": measured.position,
            "fixed": model.room.fixed_position,
            "image": position,
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


def save_examples(
    file: Path, synthesizer: str, test: Spectra, predicted: Tensor, score: Tensor, std: Tensor | None
) -> None:
    """Save measured and predicted test spectra at given quantiles of their PSNR (n,).

    Predictions (n, H, W) and standard deviations are in 256 steps.
    """
    measured, synthetic = test.store, Store(predicted)
    chosen = _at_quantiles(score.argsort(), SPECTRA_QUANTILES)
    examples = {
        "measured": as_bytes(measured[chosen]).numpy(),
        "synthetic": as_bytes(synthetic[chosen]).numpy(),
        "synthesizer": synthesizer,
        "index": test.index[chosen].numpy(),
        "psnr_db": score[chosen].numpy(),
    }
    if std is not None:
        deviation = Store(std)
        examples["deviation"] = as_bytes(deviation[chosen]).numpy()
        triples = zip(synthetic.batches(), deviation.batches(), measured.batches(), strict=True)
        examples["coverage"] = float(torch.cat([covered(*triple) for triple in triples]).mean())
    write_npz(file, examples)


def as_bytes(spectrum: Tensor) -> Tensor:
    """Return magnitudes in 256 steps, the resolution of spectra stored as images."""
    return (spectrum.clamp(0, 1) * 255).round().to(torch.uint8)


def save_located(file: Path, locator: MatchedField, measured: Spectra, test: Spectra, position: Tensor) -> None:
    """Save the room and the posteriors of six located test spectra, from the smallest position error to the largest."""
    chosen = _at_quantiles((position - test.position).norm(dim=1).argsort(), LOCATED_QUANTILES)
    posterior = locator.locate(test.subset(chosen))
    weight, best = posterior.weight.topk(min(MAX_CANDIDATES, posterior.weight.shape[1]), dim=1)
    planes = locator.room.planes
    tensors = {
        "index": test.index[chosen],
        "truth": test.position[chosen],
        "estimate": posterior.median,
        "radius": posterior.credible_radius(LEVEL),
        "candidate": posterior.position.gather(1, best[..., None].expand(-1, -1, 3)),
        "weight": weight,
        "measured": measured.position,
        "fixed": locator.room.fixed_position,
        "normal": torch.tensor([plane.normal for plane in planes], dtype=torch.float64),
        "offset": torch.tensor([plane.offset_m for plane in planes], dtype=torch.float64),
        "certain": torch.tensor([plane.certain for plane in planes]),
    }
    write_npz(file, {name: tensor.numpy() for name, tensor in tensors.items()})


def _at_quantiles(order: Tensor, quantiles: tuple[float, ...]) -> Tensor:
    """Return the rows at these quantiles of an order (n,)."""
    return order[[round(q * (len(order) - 1)) for q in quantiles]]
