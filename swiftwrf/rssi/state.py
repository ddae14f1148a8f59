"""What a fit of RSSI has finished, kept on disk."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from swiftwrf.data.rssi import Rssi
from swiftwrf.errors import InputError
from swiftwrf.rssi.solve import Fitted
from swiftwrf.runtime import checkpoint as files

KIND = "rssi fit state"
GAPS = ".gaps"  # after the name of a tensor with nan for what was not heard, which files do not hold: where it is


class State:
    """The groups of receivers that are fitted.

    Args:
        path: of the file that keeps them, written after each group; None keeps none.
        owner: fingerprint of the fit.

    Raises:
        InputError: the file is the state of another fit.
    """

    def __init__(self, path: Path | None, owner: str) -> None:
        self._path, self._owner = path, owner
        self.fitted: dict[int, Fitted] = {}
        if path is None or not path.exists():
            return
        _, tensors, header = files.read(path, KIND)
        if header.get("fingerprint") != owner:
            raise InputError(
                f"{path} is the state of another fit (other measurements or settings); remove it or give another path"
            )
        for number in header["groups"]:
            self.fitted[number] = Fitted(*(_with_gaps(tensors, f"{number}.{name}") for name in Fitted._fields))

    def add(self, number: int, fitted: Fitted) -> None:
        """Keeps one more group."""
        self.fitted[number] = fitted
        if self._path is None:
            return
        tensors = {f"{n}.{name}": value for n, f in self.fitted.items() for name, value in f._asdict().items()}
        gaps = {f"{name}{GAPS}": value.isnan() for name, value in tensors.items() if bool(value.isnan().any())}
        whole = {name: value.nan_to_num() for name, value in tensors.items()}
        files.write(self._path, KIND, whole | gaps, {"fingerprint": self._owner, "groups": list(self.fitted)})


def _with_gaps(tensors: dict[str, Tensor], name: str) -> Tensor:
    value = tensors[name]
    return value.masked_fill(tensors[name + GAPS], torch.nan) if name + GAPS in tensors else value


def fingerprint(config: Any, train: Rssi, pool: Rssi) -> str:
    """Says whether a saved state belongs to this configuration (a dataclass) and these measurements."""
    digest = hashlib.sha256(json.dumps([asdict(config), train.receiver_names]).encode())
    for tensor in (
        *(train.transmitter_position, train.receiver_position, train.rssi_dbm),
        *(pool.receiver_position, pool.rssi_dbm),
    ):
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()
