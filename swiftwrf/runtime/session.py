"""The state of a long fit, which one file keeps so that an interrupted fit can continue."""

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

Record = dict[str, Any]  # one evaluation of a fit
KIND = "fit state"


@dataclass(frozen=True)
class State:
    """Saved state of one run: plain values and tensors."""

    header: dict[str, Any]
    tensors: dict[str, Tensor]


@dataclass
class Session:
    """State shared by the runs of one fit: their checkpoint, records and callback.

    Args:
        path: Checkpoint. None keeps no state.
        owner: Fingerprint of configuration and spectra.
        bar: Progress bar.
        on_record: Called at each evaluation; at first with the records of the checkpoint.

    Attributes:
        saved: State of the interrupted run, if the checkpoint exists.
        losses: Held-out losses of completed runs by name.
        records: Records of all evaluations, including those of the checkpoint.
        earlier: Seconds of the fit up to the checkpoint.

    Raises:
        InputError: The checkpoint is damaged or belongs to another fit.
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
        if self.path is not None and self.path.exists():
            self.saved = self._read(self.path)
        for record in self.records:
            self._send(record)

    def _read(self, path: Path) -> State:
        _, tensors, header = checkpoint.read(path, KIND)
        if header.get("fingerprint") != self.owner:
            raise InputError(
                f"{path} is the state of another fit (other spectra or settings); remove it or give another path"
            )
        with checkpoint.refusing(f"{path} is no state that a fit can continue from"):
            self.losses, self.records = dict(header["losses"]), list(header["records"])
            self.earlier = float(header["elapsed"])
        return State(header, tensors)

    @property
    def elapsed(self) -> float:
        """Seconds of the fit, including those before an interruption."""
        return self.earlier + time.perf_counter() - self.began

    def evaluated(self, record: Record, tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
        """Save the record of an evaluation with the state of the current run, then send it.

        The record is saved first, so that the history after an interruption contains it once.
        """
        record = record | {"elapsed": self.elapsed}
        self.records.append(record)
        if self.path is not None:
            shared = {"losses": self.losses, "fingerprint": self.owner, "records": self.records}
            checkpoint.write(self.path, KIND, tensors, header | shared | {"elapsed": self.elapsed})
        self._send(record)

    def _send(self, record: Record) -> None:
        if self.on_record is not None:
            self.on_record(record)
