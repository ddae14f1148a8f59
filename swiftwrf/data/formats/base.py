"""What every format is, and how the one that fits is found."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Generic, TypeVar

from swiftwrf.data.rssi import Rssi
from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError
from swiftwrf.registry import Registry

Data = TypeVar("Data")


class Format(ABC, Generic[Data]):
    """A layout of files that measurements come in."""

    @abstractmethod
    def recognises(self, path: Path) -> bool:
        """Whether the folder holds files of this layout; `read` may still find them wanting."""

    @abstractmethod
    def read(self, path: Path) -> Data:
        """The measurements.

        Raises:
            InputError: what is missing, does not fit together or is not what the layout says.
        """


SPECTRA_FORMATS: Registry[Format[Spectra]] = Registry("format of spectra")
RSSI_FORMATS: Registry[Format[Rssi]] = Registry("format of RSSI")


def read(path: str | Path, formats: Registry[Format[Data]]) -> Data:
    """The measurements in a folder, by the first format that recognises it.

    Raises:
        InputError: no folder, no format that recognises it, or what the format refuses.
    """
    folder = Path(path)
    known = "; ".join(f"{entry.name}: {entry.meaning}" for entry in formats.entries())
    if not os.path.isdir(folder):  # Path.is_dir raises where a name is too long
        raise InputError(f"{folder} is not a folder; expected one of measurements ({known})")
    try:
        for entry in formats.entries():
            reader = entry.make()
            if reader.recognises(folder):
                return reader.read(folder)
    except OSError as error:
        reason = "no permission to read it" if isinstance(error, PermissionError) else error.strerror
        raise InputError(f"{error.filename or folder} cannot be read ({reason})") from None
    raise InputError(f"{folder} holds no {formats.kind} that is known ({known})")
