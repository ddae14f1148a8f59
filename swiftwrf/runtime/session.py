"""Where an interrupted fit stands: what its runs share, kept in one file."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.progress import Progress
from torch import Tensor

from swiftwrf.errors import InputError
from swiftwrf.runtime import checkpoint

Record = dict[str, Any]
KIND = "fit state"


@dataclass(frozen=True)
class Size:
    """What identifies a run of a fit.

    Args:
        final: on all spectra, or with some held out for the search.
        n_primitives, steps: how large and how long.
    """

    final: bool
    n_primitives: int
    steps: int

    @property
    def key(self) -> str:
        """Its name in a saved state."""
        return f"{'final' if self.final else 'search'} {self.n_primitives} {self.steps}"

    def __str__(self) -> str:
        steps = f", {self.steps} steps" if self.steps else ""
        return f"{'final' if self.final else 'search'}, {self.n_primitives} primitives{steps}"


@dataclass(frozen=True)
class State:
    """Where a run stood."""

    header: dict[str, Any]
    tensors: dict[str, Tensor]


@dataclass
class Session:
    """What the runs of one fit share: where their state is kept, and who is informed.

    Args:
        path: of the state; None keeps none.
        owner: fingerprint of configuration and spectra.
        bar: shows progress.
        on_record: is called at each evaluation.
        saved: the state of an earlier session of the same fit.
        losses: on held-out spectra, of runs that are done, by their key.
        records: of all evaluations of the fit, those of earlier sessions first.
        earlier: seconds that earlier sessions took, as far as their work was kept.

    Raises:
        InputError: a saved state that is damaged or of another fit.
    """

    path: Path | None
    owner: str
    bar: Progress
    on_record: Callable[[Record], None] | None
    saved: State | None = None
    losses: dict[str, float] = field(default_factory=dict)
    records: list[Record] = field(default_factory=list)
    earlier: float = 0.0
    began: float = field(default_factory=time.perf_counter)

    def __post_init__(self) -> None:
        self.saved = self._read()
        for record in self.records:
            self._inform(record)

    def _read(self) -> State | None:
        if self.path is None or not self.path.exists():
            return None
        _, tensors, header = checkpoint.read(self.path, KIND)
        if header.get("fingerprint") != self.owner:
            raise InputError(
                f"{self.path} is the state of another fit (other spectra or settings); remove it or give another path"
            )
        with checkpoint.refusing(f"{self.path} is no state that a fit can go on from"):
            self.losses, self.records = dict(header["losses"]), list(header["records"])
            self.earlier = float(header["elapsed"])
        return State(header, tensors)

    @property
    def elapsed(self) -> float:
        """Seconds that the fit took so far, over all its sessions."""
        return self.earlier + time.perf_counter() - self.began

    def evaluated(self, record: Record, tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
        """Keeps the record of an evaluation with the state of the run under way, then informs: a history that is read
        after an interruption has it once."""
        record = record | {"elapsed": self.elapsed}
        self.records.append(record)
        if self.path is not None:
            shared = {
                "losses": self.losses,
                "fingerprint": self.owner,
                "records": self.records,
                "elapsed": self.elapsed,
            }
            checkpoint.write(self.path, KIND, tensors, header | shared)
        self._inform(record)

    def _inform(self, record: Record) -> None:
        if self.on_record is not None:
            self.on_record(record)
