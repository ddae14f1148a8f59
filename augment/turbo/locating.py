"""Matched-field processing as an estimator: the test positions are located, and their directions follow."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from augment.cross_validation import LOCATOR
from augment.mix import Mixed
from augment.turbo.condition import LOCATED, Condition, MeasuredSubset, Row, located_by
from augment.turbo.experiment import Experiment
from swiftwrf import FitError, InputError, Spectra, load
from swiftwrf.locate import MatchedField, Posterior
from swiftwrf.models import FieldModel
from swiftwrf.runtime.durable import write_npz
from swiftwrf.runtime.steps import Step

LEVEL = 0.8  # of the credible regions
NO_PLANE = "no plane explains the spectra"  # why there is nothing to locate by
EXAMPLE_QUANTILES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)  # of the position error, from the best spectrum to the worst
MAX_CANDIDATES = 300  # candidate positions of largest mass that are stored of an example
BATCH_SPECTRA = 256  # spectra located at a time: a posterior has a thousand candidates


@dataclass(frozen=True)
class Locating(Step[Experiment]):
    """Locate the moving end from the test spectra by the room that was found."""

    subset: MeasuredSubset  # measured spectra
    room_file: str  # file of the room in the run's directory
    room_seconds: float = 0.0  # time of the search for the room [s], which counts as part of the training

    title = LOCATED

    @property
    def condition(self) -> Condition:
        """Condition of the result."""
        return located_by(self.subset)

    @property
    def name(self) -> str:
        return self.condition.result_name

    def compute(self, experiment: Experiment, folder: Path) -> Row:
        subset, test = self.subset, experiment.test
        measured, _ = experiment.withhold(subset)
        room = load(folder / self.room_file)
        assert isinstance(room, FieldModel)
        began = time.perf_counter()
        try:
            locator = MatchedField(seed=experiment.seed_of(subset)).fit(measured, room=room)
        except (InputError, FitError) as error:
            return {"refused": str(error)}
        fitted = time.perf_counter()
        parts = [located(locator, test.subset(rows)) for rows in torch.arange(len(test)).split(BATCH_SPECTRA)]
        found = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        ended = time.perf_counter()
        if subset.repeat == 0:
            locator.save(folder / f"{LOCATOR}-mix{subset.key}.safetensors")
            write_npz(folder / f"located-mix{subset.key}.npz", examples(locator, measured, test, found))
        seconds = {"room": self.room_seconds, "fit": fitted - began, "locate": ended - fitted}
        return {
            "estimate": found.pop("estimate"),
            "located": found | {"weights": locator.weight, "seconds": seconds},
            "seconds": {"train": seconds["room"] + seconds["fit"], "estimate": seconds["locate"]},
            "history": [],
            "counts": Mixed.measured(measured).counts,
        }


def located(locator: MatchedField, test: Spectra) -> dict[str, Tensor]:
    """Return position and direction by the posteriors of test spectra.

    Returns:
        estimate: Azimuth and elevation (n, 2) [rad].
        position: Posterior median (n, 3) [m].
        radius: Radius of the 80 % credible region (n,) [m].
        level: Smallest level whose credible region contains the true position, (n,).
        ambiguous: True where a second mode has much of the posterior mass, (n,).
    """
    posterior = locator.locate(test)
    position = posterior.median
    return {
        "estimate": locator.direction(posterior),
        "position": position,
        "radius": posterior.credible_radius(LEVEL),
        "level": containing_level(posterior, test.position),
        "ambiguous": posterior.ambiguous,
    }


def containing_level(posterior: Posterior, truth: Tensor) -> Tensor:
    """Return the smallest level (n,) whose credible region, a ball around the median, contains the position (n, 3) [m].

    Example:
        >>> at = torch.tensor([[[0.0, 0, 0], [1.0, 0, 0]]], dtype=torch.float64)
        >>> posterior = Posterior(at, torch.tensor([[0.75, 0.25]], dtype=torch.float64).log())
        >>> containing_level(posterior, torch.tensor([[0.5, 0, 0]], dtype=torch.float64))
        tensor([0.7500], dtype=torch.float64)
    """
    median = posterior.median
    # the inverse of the credible radius
    error = (truth - median).norm(dim=1) / posterior.inflation - posterior.resolution_m / 4
    inside = (posterior.position - median[:, None]).norm(dim=2) < error[:, None]
    level: Tensor = (posterior.weight * inside).sum(dim=1)
    return level


def examples(
    locator: MatchedField, measured: Spectra, test: Spectra, found: dict[str, Tensor]
) -> dict[str, NDArray[Any]]:
    """Return the room and the posteriors of six located test spectra, from the smallest position error to the largest."""
    order = (found["position"] - test.position).norm(dim=1).argsort()
    chosen = order[[round(q * (len(order) - 1)) for q in EXAMPLE_QUANTILES]]
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
    return {name: tensor.numpy() for name, tensor in tensors.items()}
