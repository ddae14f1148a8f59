"""The state of a fit in one file, so that an interrupted fit can continue."""

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
class State:
    """Saved state of one optimisation: plain values and tensors."""

    header: dict[str, Any]
    tensors: dict[str, Tensor]


@dataclass
class Session:
    """The file of a fit's state, shared by all optimisations of the fit.

    Args:
        path: File of the state. With None nothing is saved.
        owner: Fingerprint of configuration and training data. It identifies the fit.
        bar: Progress bar.
        on_record: Called with the record of each evaluation, those of earlier sessions first.

    Raises:
        InputError: The saved state is damaged or of another fit.

    Example:
        >>> from swiftwrf.runtime.progress import progress_bar
        >>> session = Session(None, "fingerprint", progress_bar(False), on_record=None)
        >>> session.evaluated({"step": 10, "loss": 0.5}, {}, {})
        >>> session.records[0]["loss"]
        0.5
    """

    path: Path | None
    owner: str
    bar: Progress
    on_record: Callable[[Record], None] | None
    saved: State | None = field(init=False)
    """state of the optimisation that an earlier session interrupted"""
    losses: dict[str, float] = field(init=False, default_factory=dict)
    """loss on held-out spectra of finished optimisations, by name"""
    records: list[Record] = field(init=False, default_factory=list)
    """records of all evaluations of the fit, those of earlier sessions first"""

    def __post_init__(self) -> None:
        self._earlier, self._began = 0.0, time.perf_counter()
        self.saved = self._read()
        for record in self.records:
            self._send(record)

    def _read(self) -> State | None:
        if self.path is None or not self.path.exists():
            return None
        _, tensors, header = checkpoint.read(self.path, KIND)
        if header.get("fingerprint") != self.owner:
            raise InputError(
                f"{self.path} is the state of another fit (other spectra or options); remove it or give another path"
            )
        with checkpoint.refusing(f"{self.path} holds no state from which a fit can continue"):
            self.losses, self.records = dict(header["losses"]), list(header["records"])
            self._earlier = float(header["elapsed"])
        return State(header, tensors)

    @property
    def elapsed(self) -> float:
        """Duration of the fit over all its sessions [s]."""
        return self._earlier + time.perf_counter() - self._began

    def evaluated(self, record: Record, tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
        """Save an evaluation with the state of the optimisation, then send its record.

        Saving comes first, so that a history that continues after an interruption contains each record once.

        Args:
            record: Plain values, e.g. step and loss.
            tensors: Tensors of the state.
            header: Plain values of the state.
        """
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
        self._send(record)

    def _send(self, record: Record) -> None:
        if self.on_record is not None:
            self.on_record(record)
