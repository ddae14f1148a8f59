"""The interface of a reader, and the search for the one that recognises a source."""

from __future__ import annotations

import logging
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from swiftwrf.array.angles import AngularGrid
from swiftwrf.array.beamforming import PHASE
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.archives import ARCHIVES, array_names
from swiftwrf.data.options import TableOptions
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.snapshots import Snapshots
from swiftwrf.data.spectra import Spectra
from swiftwrf.errors import InputError, listed
from swiftwrf.runtime.registry import Registry
from swiftwrf.runtime.validation import PositiveFloat, PositiveInt, configuration

LINEAR_ARRAY = (
    "the elements lie on a line, so the array receives the angle to its axis only; directions are folded to the half-plane "
    "of axis and normal"
)
logger = logging.getLogger(__name__)
Data = TypeVar("Data", bound=Spectra | Snapshots | Rssi)


@configuration
class ReadOptions(TableOptions):
    """Options of reading that files leave open: the arguments of `load_spectra` and `load_rssi`.

    A reader names those that it takes, and others are refused.

    Example:
        >>> ReadOptions(every=2).given
        {'every': 2}
    """

    array: PlanarArray | None = None
    arrays: Mapping[str, str] | None = None
    beamformer: str | None = None
    grid: AngularGrid | tuple[PositiveInt, PositiveInt] | None = None
    every: PositiveInt | None = None
    station: PositiveInt | None = None
    subcarriers: PositiveInt | None = None
    bandwidth: PositiveFloat | None = None
    drop_null: bool = False
    drop_elements: tuple[int, ...] = ()
    round_trip: bool = False
    sender: str | None = None

    @property
    def given(self) -> dict[str, Any]:
        """Options that differ from their defaults, by name."""
        values = {field.name: (getattr(self, field.name), field.default) for field in fields(self)}
        return {name: value for name, (value, default) in values.items() if value != default}

    def spectra_of(self, data: Any) -> Any:
        """Return the spectra of array snapshots, and other data as they are."""
        return data.spectra(self.grid, self.beamformer or PHASE) if isinstance(data, Snapshots) else data


class Format(ABC, Generic[Data]):
    """Reader of one layout of files. A subclass needs two methods and an entry in a registry.

    Readers of other packages are entry points of the groups `swiftwrf.readers.spectra`, `swiftwrf.readers.snapshots` and
    `swiftwrf.readers.rssi`, each naming such a class.

    Example:
        >>> class Archive(Format[Spectra]):
        ...     def recognises(self, path: Path) -> bool:
        ...         return path.suffix == ".pt"
        ...     def read(self, path: Path, options: ReadOptions) -> Spectra:
        ...         content = torch.load(path, weights_only=True)
        ...         return Spectra(content["spectra"], content["position"], name=path.stem)
    """

    takes: ClassVar[frozenset[str]] = frozenset()
    """names of the `ReadOptions` that the reader uses"""

    @abstractmethod
    def recognises(self, path: Path) -> bool:
        """Return True if the folder or file is of this layout, though `read` may find it incomplete."""

    def stations(self, path: Path) -> list[str]:
        """Return the names of the arrays in a source that describes several; `ReadOptions.station` chooses one from 1 on."""
        return []

    @abstractmethod
    def read(self, path: Path, options: ReadOptions) -> Data:
        """Return the measurements.

        Raises:
            InputError: A part that is missing or invalid, or parts that do not match.
        """


SPECTRA_FORMATS: Registry[Format[Spectra]] = Registry(
    "format of spectra",
    "swiftwrf.readers.spectra",
    {
        "deepmimo": "swiftwrf.contrib.formats.deepmimo:DeepMimo",
        "nerf2": "swiftwrf.data.formats.nerf2:Nerf2",
        "paths": "swiftwrf.data.formats.paths:PathArchive",
    },
)
SNAPSHOT_FORMATS: Registry[Format[Snapshots]] = Registry(
    "format of array snapshots",
    "swiftwrf.readers.snapshots",
    {
        "snapshots": "swiftwrf.data.formats.snapshots:SnapshotArrays",
        "captures": "swiftwrf.contrib.formats.captures:Captures",
        "records": "swiftwrf.contrib.formats.records:Records",
    },
)
RSSI_FORMATS: Registry[Format[Rssi]] = Registry(
    "format of RSSI",
    "swiftwrf.readers.rssi",
    {"nerf2": "swiftwrf.data.formats.nerf2:Nerf2Rssi", "survey": "swiftwrf.data.formats.survey:SurveyTable"},
)


def _readers(source: Path, options: ReadOptions, *registries: Registry[Format[Any]]) -> list[tuple[str, Format[Any]]]:
    """Return the formats that recognise a source, by name. Names of arrays state the format."""
    readers = [(name, registry[name]()) for registry in registries for name in registry]
    return [(n, r) for n, r in readers if ("arrays" in r.takes if options.arrays else r.recognises(source))]


def reader_of(path: Path, options: ReadOptions, *registries: Registry[Format[Any]]) -> Format[Any] | None:
    """Return the one format that recognises a source, None if there is none or several.

    Example:
        >>> reader_of(Path("nowhere"), ReadOptions(), SPECTRA_FORMATS) is None
        True
    """
    found = _readers(path, options, *registries) if path.exists() else []
    return found[0][1] if len(found) == 1 else None


def read(path: str | Path, options: ReadOptions, *registries: Registry[Format[Any]]) -> Any:
    """Return the measurements in a folder or file, read by the format that recognises it.

    Args:
        path: Folder or file.
        options: What the user states about the files.
        registries: Formats to try.

    Raises:
        InputError: No such source, none or several formats that recognise it, an option that the format does not take, or
            what the format refuses.
    """
    source = Path(path)
    known = ", ".join(dict.fromkeys(name for registry in registries for name in registry))
    if not os.path.isdir(source) and not os.path.isfile(source):  # Path.is_dir raises for a name that is too long
        raise InputError(f"{source} is not a folder or file; expected measurements (formats: {known})")
    try:
        matches = _readers(source, options, *registries)
        if not matches:
            others: dict[str, Registry[Format[Any]]] = {
                "spectra": SPECTRA_FORMATS,
                "array snapshots": SNAPSHOT_FORMATS,
                "RSSI": RSSI_FORMATS,
            }
            here = sorted(kind for kind, registry in others.items() if registry in registries)
            for kind in others:
                if kind not in here and _readers(source, options, others[kind]):
                    commands = "rssi and swiftwrf locate" if kind == "RSSI" else "aoa"
                    raise InputError(
                        f"{source} looks like {kind}, which swiftwrf {commands} can read; expected {' or '.join(here)}"
                    )
            raise InputError(
                f"{source} is in none of the known formats ({known}); docs/formats.md describes them{_held(source)}"
            )
        if len(matches) > 1:
            names = " and ".join(name for name, _ in matches)
            raise InputError(
                f"{source} holds several formats ({names}); keep one in the folder, or name the file itself"
            )
        ((name, reader),) = matches
        logger.info("%s is read as %s", source, name)
        for option in options.given:
            if option not in reader.takes:
                raise InputError(f"{source} is read as {name}, which takes no {option}; leave it out")
        data = reader.read(source, options)
    except OSError as error:
        reason = "no permission to read it" if isinstance(error, PermissionError) else error.strerror
        raise InputError(f"{error.filename or source} cannot be read ({reason})") from None
    array = getattr(data, "array", None)
    return data if array is None or array.axis is None else replace(data, notes=(*data.notes, LINEAR_ARRAY))


def _held(source: Path) -> str:
    """Return in words what the only archive of arrays of a source holds, and what to do; empty without one."""
    files = [source] if source.is_file() else list(source.iterdir())
    archives = [file for file in files if file.suffix in ARCHIVES]
    if len(archives) != 1 or not (names := array_names(archives[0])):
        return ""
    held = f"{archives[0].name} holds {listed(sorted(names))}"
    return f"; {held}: if it has array snapshots, give --arrays csi=NAME position=NAME ..."


def read_spectra(path: str | Path, options: ReadOptions) -> Spectra:
    """Return the spectra in a folder or file, or those of its array snapshots.

    Raises:
        InputError: As `read`.
    """
    spectra: Spectra = options.spectra_of(read(path, options, SPECTRA_FORMATS, SNAPSHOT_FORMATS))
    return spectra


def station(holds: str, names: Sequence[str], number: int | None) -> int:
    """Return the index of the array with a number from 1, or of the only one; `holds` begins the sentence of refusal."""
    if (number is None and len(names) > 1) or not 1 <= (number or 1) <= len(names):
        known = listed(f"{i} {name}" for i, name in enumerate(names, start=1))
        raise InputError(f"{holds}; choose one by its number: station ({known})")
    return (number or 1) - 1
