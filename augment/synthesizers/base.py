"""What every synthesizer is, and how one is made by its name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor
from torch.distributed import ProcessGroup

from swiftwrf import Spectra
from swiftwrf.data.splits import Validation
from swiftwrf.runtime.checkpoint import Saved
from swiftwrf.runtime.registry import Registry


@dataclass(frozen=True)
class Settings:
    """What a synthesizer may be given; each takes what it needs.

    Args:
        validation: how training spectra are held out to choose settings: at random, or a region at a time where the
            positions to come lie apart from the measured ones.
        seed: of what is random.
        preset: quick is sized for a CPU, paper is the publication's.
        device: where to compute.
        checkpoint: a file that keeps the state of a long fit; where it exists, the fit goes on from it.
        on_record: called with the records of a fit.
        progress: show a progress bar on a terminal.
        scene: of `raytrace`: a built-in room or a scene file, instead of the room that the spectra show.
        group: processes of `torch.distributed` that fit one of those that are `shared`.
    """

    validation: Validation = "random"
    seed: int = 0
    preset: Literal["quick", "paper"] = "quick"
    device: torch.device | str = "cpu"
    checkpoint: Path | None = None
    on_record: Callable[[dict[str, Any]], None] | None = None
    progress: bool = True
    scene: str | None = None
    group: ProcessGroup | None = None


class Synthesizer(ABC):
    """Learns from spectra, then draws one at any position."""

    samples: ClassVar[bool] = False
    """whether `synthesize` can draw instead of predicting the mean"""
    shared: ClassVar[bool] = False
    """whether several processes fit one together"""
    shared_seconds: float = 0.0
    """of its fit, spent by another synthesizer that needed the same"""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    @abstractmethod
    def fit(self, train: Spectra) -> None:
        """Learns; `train` is all it ever sees."""

    def fit_like(self, other: Synthesizer, train: Spectra) -> None:
        """Learns as another one of its kind did from other spectra of the scene, whose search it need not repeat."""
        self.fit(train)

    @abstractmethod
    def synthesize(self, position: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Magnitudes in [0, 1], float32 (n, H, W), at positions (n, 3) [m].

        Without a generator the most plausible spectra, and with one, for those that can, spectra as plausible as any: a
        network that learns from means sees less of the world than there is.
        """

    def deviation(self, position: Tensor) -> Tensor | None:
        """By how much a measured spectrum is expected to differ from the synthesized one: standard deviations, float32
        (n, H, W); None where that is unknown."""
        return None

    @property
    def model(self) -> Saved | None:
        """What was fitted, where it can be saved."""
        return None


SYNTHESIZERS: Registry[Synthesizer] = Registry("synthesizer")
ARRAY, FIXED_END = "array", "fixed end"  # what a synthesizer may need of the data


def make_synthesizer(name: str, settings: Settings | None = None) -> Synthesizer:
    """The synthesizer of that name.

    Raises:
        InputError: an unknown name.
    """
    return SYNTHESIZERS[name].make(settings or Settings())


def lacks(name: str, data: Spectra) -> list[str]:
    """What the synthesizer of that name needs and the data do not tell."""
    known = {ARRAY: data.array is not None, FIXED_END: data.fixed_position is not None and data.rotation is not None}
    return [need for need in SYNTHESIZERS[name].needs if not known[need]]
