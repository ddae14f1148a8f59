"""What every format is, and how the one that fits is found."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from swiftwrf.data.reading import Reading
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError
from swiftwrf.runtime.registry import Registry

Data = TypeVar("Data")


class Format(ABC, Generic[Data]):
    """A layout of files that measurements come in; `takes` names what a user may say of them (`Reading`)."""

    takes: ClassVar[frozenset[str]] = frozenset()

    @abstractmethod
    def recognises(self, path: Path) -> bool:
        """Whether the folder or file is of this layout; `read` may still find it wanting."""

    @abstractmethod
    def read(self, path: Path, how: Reading) -> Data:
        """The measurements.

        Raises:
            InputError: what is missing, does not fit together or is not what the layout says.
        """


SPECTRA_FORMATS: Registry[Format[Spectra]] = Registry("format of spectra", "swiftwrf.readers.spectra")
SNAPSHOT_FORMATS: Registry[Format[Snapshots]] = Registry("format of array snapshots", "swiftwrf.readers.snapshots")
RSSI_FORMATS: Registry[Format[Rssi]] = Registry("format of RSSI", "swiftwrf.readers.rssi")


def read(path: str | Path, how: Reading, *registries: Registry[Format[Any]]) -> Any:
    """The measurements in a folder or file, by the format that recognises it.

    Raises:
        InputError: nothing there, no format that recognises it or more than one, what the format refuses, or something in
            `how` that does not apply to it.
    """
    source = Path(path)
    known = ", ".join(name for registry in registries for name in registry)
    if not os.path.isdir(source) and not os.path.isfile(source):  # Path.is_dir raises where a name is too long
        raise InputError(f"{source} is not a folder or file; expected measurements (formats: {known})")
    try:
        name, reader = _find(source, known, registries)
        for option in how.given:
            if option not in reader.takes:
                raise InputError(f"{source} is read as {name}, which takes no {option}; leave it out")
        return reader.read(source, how)
    except OSError as error:
        reason = "no permission to read it" if isinstance(error, PermissionError) else error.strerror
        raise InputError(f"{error.filename or source} cannot be read ({reason})") from None


def _find(source: Path, known: str, registries: tuple[Registry[Any], ...]) -> tuple[str, Format[Any]]:
    """The one format that recognises the source: of two, either would be a guess."""
    readers = [(name, registry[name]()) for registry in registries for name in registry]
    found = [(name, reader) for name, reader in readers if reader.recognises(source)]
    if not found:
        kinds = " or ".join(registry.kind for registry in registries)
        raise InputError(f"{source} holds no {kinds} that is known ({known}); docs/formats.md describes them")
    if len(found) > 1:
        names = " and ".join(name for name, _ in found)
        raise InputError(f"{source} holds several formats ({names}); keep one in the folder, or name the file itself")
    return found[0]
