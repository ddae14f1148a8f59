"""What every predictor of RSSI is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import torch
from torch import Tensor

from swiftwrf import Rssi
from swiftwrf.data.splits import Validation
from swiftwrf.rssi import Map
from swiftwrf.runtime.registry import Registry

RECEIVERS = "positions of the receivers"  # what predictors of the log-distance law need of the data
SLOW = ("nerf2", "blend")  # compared only where they are asked for


class Predictor(Protocol):
    """Learns from rows where RSSI was heard, then tells it at any position."""

    def fit(self, train: Rssi) -> None:
        """Learns; `train` is all it ever sees."""

    def predict(self, position: Tensor) -> Tensor:
        """RSSI (n, R) [dBm] at transmitter positions (n, 3) [m]."""


@dataclass(frozen=True)
class Settings:
    """What a predictor is made from.

    Args:
        validation: how training rows are held out to choose its settings.
        seed: of what is random.
        preset: of SwiftWRF and NeRF2: `quick`, or `paper` for the plain head and the published field.
        device: where these compute.
        parallel: how SwiftWRF's groups of receivers are mapped.
        pool: the training rows at every receiver of the data; those asked for unless given.
    """

    validation: Validation = "random"
    seed: int = 0
    preset: Literal["quick", "paper"] = "quick"
    device: torch.device | str = "cpu"
    parallel: Map = map
    pool: Rssi | None = None


PREDICTORS = Registry[Predictor]("predictor")


def lacks(name: str, data: Rssi) -> str:
    """Why a predictor cannot be had of these data, in a sentence; nothing where it can."""
    if RECEIVERS in PREDICTORS[name].needs and not data.located:
        return f"{name} needs the {RECEIVERS}, which {data.name} does not tell"
    return ""
