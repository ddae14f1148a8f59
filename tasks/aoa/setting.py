"""What all steps of a run share, and which share and repeat one is of."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from augment import Places, draw_places, withhold
from augment import Settings as SynthesizerSettings
from swiftwrf import Spectra
from tasks.aoa.config import AoaConfig
from tasks.aoa.estimators import Settings
from tasks.run import Row


@dataclass(frozen=True)
class At:
    """A measured share in one of the repeats."""

    share: float
    repeat: int

    def __str__(self) -> str:
        return f"mix{self.share:g}-r{self.repeat}"

    @property
    def row(self) -> Row:
        """Columns of the tables."""
        return {"mix": self.share, "repeat": self.repeat}


@dataclass(frozen=True, eq=False)
class Setting:
    """What all steps of a run share.

    Args:
        config: of the run.
        train, test: spectra of the split.
        extra: number of further positions at which spectra are synthesized.
        device: where to compute.
    """

    config: AoaConfig
    train: Spectra
    test: Spectra
    extra: int
    device: torch.device

    def withhold(self, at: At) -> tuple[Spectra, Places]:
        """The measured spectra, and the places of the others."""
        return withhold(self.train, at.share, self.config.seed + at.repeat)

    def further(self, at: At, measured: Spectra) -> Places:
        """Further places in the region of the measured ones."""
        return draw_places(measured, self.extra, self.config.seed + at.repeat)

    def of_synthesizers(self, at: At) -> SynthesizerSettings:
        """What synthesizers are made with."""
        return SynthesizerSettings(
            validation="random",  # the withheld places lie among the measured ones, whatever the split of the test
            seed=self.config.seed + at.repeat,
            preset=self.config.preset,
            device=self.device,
            scene=self.config.scene,
        )

    def of_estimators(self, at: At) -> Settings:
        """What estimators are made with."""
        return Settings(
            self.train.grid, self.config.seed + at.repeat, self.device, self.config.preset, spectra=len(self.train)
        )
