"""The synthesizers as a registry, over today's `augment`: goes when `augment` has one (see the imports of this module)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

import augment
from augment import Synthesizer
from swiftwrf import FitConfig
from swiftwrf.fit_config import Validation
from swiftwrf.registry import Registry


@dataclass(frozen=True)
class Settings:
    """What synthesizers are made with."""

    validation: Validation = "random"
    seed: int = 0
    preset: str = "quick"
    device: torch.device | str = "cpu"
    checkpoint: Path | None = None
    on_record: Callable[[dict[str, Any]], None] | None = None


def make_synthesizer(name: str, settings: Settings) -> Synthesizer:
    """The synthesizer of that name."""
    return SYNTHESIZERS[name].make(settings)


def model_of(synthesizer: Any) -> Any:
    """Its fitted model, or None."""
    return synthesizer if hasattr(synthesizer, "save") else None


def _make(name: str, settings: Settings) -> Synthesizer:
    config = FitConfig.paper() if settings.preset == "paper" else FitConfig()
    return augment.make_synthesizer(
        name,
        validation=settings.validation,
        seed=settings.seed,
        config=config,
        device=settings.device,
        checkpoint=settings.checkpoint,
        on_record=settings.on_record,
    )


_MEANING = {
    "swiftwrf": ("2D Gaussians that move with the position", "#4477aa"),
    "nearest": ("the spectrum of the nearest measured position", "#ccbb44"),
    "idw": ("inverse-distance mean of the nearest spectra", "#66ccee"),
    "gp": ("a Gaussian process on the pixels", "#ee8866"),
    "coarray": ("the squared spectrum in the space of the array's physics", "#aa3377"),
}
SYNTHESIZERS: Registry[Synthesizer] = Registry("synthesizer")
for _name, (_meaning, _colour) in _MEANING.items():
    _needs = ("array",) if _name == "coarray" else ()
    SYNTHESIZERS.register(_name, meaning=_meaning, needs=_needs, colour=_colour)(partial(_make, _name))
