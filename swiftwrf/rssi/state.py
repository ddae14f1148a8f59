"""What a fit of RSSI has finished, kept on disk."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from swiftwrf import checkpoint as files
from swiftwrf.data.rssi import Rssi
from swiftwrf.errors import InputError
from swiftwrf.rssi.solve import Fitted

KIND = "rssi fit state"


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
            self.fitted[number] = Fitted(*(tensors[f"{number}.{name}"] for name in Fitted._fields))

    def add(self, number: int, fitted: Fitted) -> None:
        """Keeps one more group."""
        self.fitted[number] = fitted
        if self._path is None:
            return
        tensors = {f"{n}.{name}": value for n, f in self.fitted.items() for name, value in f._asdict().items()}
        files.write(self._path, KIND, tensors, {"fingerprint": self._owner, "groups": list(self.fitted)})


def fingerprint(config: Any, train: Rssi, pool: Rssi) -> str:
    """Says whether a saved state belongs to this configuration (a dataclass) and these measurements."""
    digest = hashlib.sha256(json.dumps([asdict(config), train.receiver_names]).encode())
    for tensor in (train.transmitter_position, train.receiver_position, train.rssi_dbm, pool.rssi_dbm):
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()
