"""How RSSI is modelled and fitted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from swiftwrf.data.splits import Validation


@dataclass(frozen=True)
class RssiConfig:
    """How RSSI is modelled and fitted. The defaults are what measured best on held-out training rows."""

    n_primitives: int = 50
    """a receiver; none where held-out rows are predicted no better with a field than by the log-distance law"""
    huber: float = 1.345
    """errors beyond so many standard deviations of the noise count linearly (Huber's constant: 95 % efficient where the
    noise is Gaussian), for packets have outliers"""
    validation: Validation = "random"
    """what is held out inside the training part: single rows, or a region"""
    plain: bool = False
    """the plain head, rssi = 100 (pooled - 1), its primitives learnt step by step; otherwise primitives as drawn, on a
    log-distance law with directivity, in closed form"""
    steps: int = 600
    """of the plain head's optimisation"""
    batch: int = 1024
    """rows a step"""
    rate: float = 5e-2
    """of a step"""
    seed: int = 0

    @classmethod
    def paper(cls, **changes: Any) -> RssiConfig:
        """The plain head: 50 learnt primitives a receiver, their averaged magnitude and nothing else. The paper leaves the
        scale of its target open; this is NeRF2's."""
        return replace(cls(plain=True), **changes)
