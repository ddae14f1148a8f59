"""What all methods share: their sizes, their training, the fit."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch

from swiftwrf.data.spectra import Spectra, check_training, fingerprint
from swiftwrf.errors import InputError
from swiftwrf.runtime.descent import Descent, Model, Schedule, warm_cosine
from swiftwrf.runtime.progress import progress_bar
from swiftwrf.runtime.session import Record, Session

LARGEST, MOST_LAYERS = 2**24, 64  # of a model: what a file claims is believed only so far


@dataclass(frozen=True)
class Size:
    """What a model consists of: whole numbers and lengths, all above 0."""

    def check(self) -> None:
        """Refuses what no model can have, wherever it comes from.

        Raises:
            InputError: such a number.
        """
        for field in fields(self):
            value, whole = getattr(self, field.name), type(field.default) is int
            limit = MOST_LAYERS if field.name == "depth" else LARGEST
            right = type(value) is int if whole else type(value) in (int, float)
            if not right or not 0 < value <= limit:
                raise InputError(f"{field.name} must be a number above 0 and at most {limit}, got {value!r}")


AnySize = TypeVar("AnySize", bound=Size)


@dataclass(frozen=True)
class Config(ABC, Generic[AnySize, Model]):
    """How a model is sized and trained; the defaults of each method are its quick preset."""

    size: AnySize
    steps: int
    """of the optimisation"""
    batch: int
    """spectra a step"""
    rate: float
    """largest learning rate"""
    warm_up: int = 50
    """steps over which the rates rise"""
    final_rate: float = 0.02
    """share of the rates that is left when they have decayed"""
    decay_steps: int | None = None
    """steps in which they decay, along a cosine that goes on afterwards; all steps unless given"""
    averaging: float = 0.98
    """by how much a step's weight in the averaged parameters decays a step; 0 keeps the last ones"""
    clip: float = 1.0
    """largest norm of the gradient"""
    check_every: int = 50
    """steps between two evaluations, at which progress is recorded and the state kept"""
    seed: int = 0

    @classmethod
    @abstractmethod
    def paper(cls, **changes: Any) -> Config[AnySize, Model]:
        """The size and the training of the publication."""

    @abstractmethod
    def training(self, train: Any, device: torch.device) -> Training[Any, Model]:
        """At its start."""


AnyConfig = TypeVar("AnyConfig", bound=Config[Any, Any])


class Training(Descent[Model], Generic[AnyConfig, Model]):
    """Trains the model of a configuration.

    Whatever a step draws at random comes from a generator of that step's own, so that a training that goes on draws the
    same.

    Args:
        config: how.
        model: at its start, on its device.
        groups: parameter groups of Adam; all parameters with the configuration's rate unless given.
        betas, weight_decay: of Adam.
    """

    def __init__(
        self,
        config: AnyConfig,
        model: Model,
        groups: Iterable[dict[str, Any]] | None = None,
        *,
        betas: tuple[float, float] = (0.9, 0.99),
        weight_decay: float = 0.0,
    ) -> None:
        schedule = Schedule(config.steps, config.check_every, config.averaging, config.clip, betas, weight_decay)
        super().__init__(
            "final", model, groups or [{"params": list(model.parameters()), "peak": config.rate}], schedule
        )
        self.config = config

    def rate(self, step: int) -> float:
        own = self.config
        return warm_cosine(step, own.decay_steps or own.steps, own.warm_up, own.final_rate)

    def generator(self) -> torch.Generator:
        """For what the next step draws."""
        (state,) = np.random.SeedSequence((self.config.seed, self.step)).generate_state(1)
        return torch.Generator().manual_seed(int(state))


def descend(
    training: Training[Any, Model],
    owner: str,
    checkpoint: Path | None,
    on_record: Callable[[Record], None] | None,
    progress: bool,
) -> Model:
    """The model after all steps; see `fit`. `owner` is the fingerprint of the fit."""
    with progress_bar(progress) as bar:
        training.run(Session(checkpoint, owner, bar, on_record))
    return training.result.eval()


def fit(
    train: Spectra,
    config: Config[Any, Model],
    *,
    device: torch.device | str = "cpu",
    checkpoint: Path | None = None,
    on_record: Callable[[Record], None] | None = None,
    progress: bool = True,
) -> Model:
    """Fits the model of a configuration to spectra; same data, configuration and machine give the same model.

    Args:
        train: the only spectra it sees.
        config: which method, and how.
        device: where to compute.
        checkpoint: a file that keeps the state of the fit; where it exists, the fit goes on from it.
        on_record: called at each evaluation with stage, step, loss and seconds; a fit that goes on begins with the records
            of its earlier sessions.
        progress: show a progress bar on a terminal.

    Raises:
        InputError: fewer than 10 spectra, something not finite, something that the method needs and the data do not tell,
            or a checkpoint of another fit.
        FitError: a loss or gradient that is not finite (the checkpoint holds the last good state), or a fit that ends
            worse than it began.
    """
    check_training(train)
    owner = fingerprint(train, type(config).__name__, asdict(config))
    return descend(config.training(train, torch.device(device)), owner, checkpoint, on_record, progress)
