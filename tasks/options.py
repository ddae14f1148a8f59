"""Options of commands: their base classes, and the checks that need no data. Importable without torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, Field, asdict, dataclass, fields
from inspect import get_annotations
from typing import Annotated, Any, ClassVar, Literal, TypeVar, dataclass_transform
from unicodedata import category

import tyro

from swiftwrf.errors import InputError
from swiftwrf.runtime.registry import Registry
from tasks import labels

SEEDS = 2**32  # number of seeds that the generators of scikit-learn and NumPy accept
MAX_SIDE = 32  # elements: spectra of 32 x 32 elements have 7,938 independent numbers

Class = TypeVar("Class", bound=type)


@dataclass_transform(frozen_default=True)
def command_options(cls: Class) -> Class:
    """Make a class a frozen dataclass whose help lists required options first and inherited ones last."""
    made: Any = dataclass(frozen=True)(cls)
    own = cls.__annotations__

    def place(item: tuple[str, Field[Any]]) -> tuple[bool, bool]:
        return item[1].default is not MISSING, item[0] not in own

    made.__dataclass_fields__ = dict(sorted(made.__dataclass_fields__.items(), key=place))
    return cls


@dataclass(frozen=True, kw_only=True)
class Options:
    """Base class of the options of a command. The docstring of a subclass is the description in its help.

    `check` runs before the modules of the command are imported, so a wrong value is refused at once.
    """

    group: ClassVar[str] = "command"
    """group of the options in the help of a command that inherits them"""
    resumable: ClassVar[bool] = False
    """whether an interrupted run of the command can be continued"""

    def check(self) -> None:
        """Refuse options that are wrong whatever the data. Subclasses extend it.

        Raises:
            InputError: Empty text, control characters, a number that is not finite, or a seed that generators do not accept.
        """
        for option in fields(self):
            flag, given = f"--{option.name.replace('_', '-')}", getattr(self, option.name)
            for value in given if isinstance(given, tuple) else (given,):
                if value == "":
                    raise InputError(f"{flag} is empty; give it a value or leave it out")
                if isinstance(value, str) and any(category(letter) in ("Cc", "Cs") for letter in value):
                    raise InputError(
                        f"{flag} {value!a} holds control characters or is not UTF-8; give it another value"
                    )
                if isinstance(value, float) and not math.isfinite(value):
                    raise InputError(f"{flag} takes finite numbers, got {value}")
            if option.name == "seed" and not 0 <= given < SEEDS:
                raise InputError(f"--seed must be from 0 to {SEEDS - 1}, got {given}")


@dataclass(frozen=True, kw_only=True)
class Answered(Options):
    """Options of a command with an answer. They are no part of a run's configuration."""

    group: ClassVar[str] = "output"

    quiet: bool = False
    """print the answer only, no progress and no notes"""
    json: bool = False
    """print the answer as one JSON object, and nothing else"""


@dataclass(frozen=True, kw_only=True)
class Output(Answered):
    """Options of a command with an answer and a report."""

    group: ClassVar[str] = "output"

    open: bool = False
    """open the report in the browser at the end"""


OUTPUT = tuple(option.name for option in fields(Output))


def plain(config: Any) -> dict[str, Any]:
    """Return the options of a command as plain values, without those of what it shows."""
    return {name: value for name, value in asdict(config).items() if name not in OUTPUT}


def choice(meaning: str, registry: Registry[Any] | None, known: Mapping[str, labels.Label], default: str) -> Any:
    """Return the annotation of an option that takes names of a registry. Its help lists the names.

    Args:
        meaning: Meaning of the option.
        registry: Registry of the names. None if `known` has all of them.
        known: Labels by name. Names of other packages have the first line of their docstring.
        default: Default that the help shows.
    """

    def entries(_: str) -> str:
        found = known if registry is None else labels.labels(registry, dict(known))
        return f"{'; '.join(f'{name}: {label.meaning}' for name, label in found.items())} (default: {default})"

    return tyro.conf.arg(help=f"{meaning}:", help_behavior_hint=entries)


@dataclass(frozen=True, kw_only=True)
class SpectraSource(Options):
    """Options of reading spectra."""

    group: ClassVar[str] = "spectra"

    array: tuple[int, float, float] | tuple[int, int, float, float] | None = None
    """array of the spectra if the data do not describe it, or for which spectra of ray paths are computed: elements a side,
    spacing [m], carrier [Hz] of a square array, or rows, columns, spacing [m], carrier [Hz]"""
    beamformer: Annotated[str | None, choice("beamformer for array snapshots", None, labels.BEAMFORMERS, "phase")] = (
        None
    )
    grid: tuple[int, int] | None = None
    """elevations and azimuths of computed spectra (default: 90 360)"""
    every: int | None = None
    """reads one measurement of that many"""
    station: int | None = None
    """number of the array in a file with several, counted from 1"""
    subcarriers: int | None = None
    """number of subcarriers at which the channel is computed from ray paths (default: spectra alone)"""
    bandwidth: float | None = None
    """distance of the first and the last of these subcarriers [Hz]"""
    drop_null: bool = False
    """leave out null subcarriers of array snapshots, which are the same at every position and element"""
    round_trip: bool = False
    """phases of array snapshots are those of the way there and back, as of RFID and backscatter"""

    def check(self) -> None:
        super().check()
        if self.beamformer is not None and self.beamformer not in labels.BEAMFORMERS:
            raise InputError(f"unknown beamformer {self.beamformer!r}; choose from {', '.join(labels.BEAMFORMERS)}")
        if self.array is not None:
            self._check_array(*self.array)
        if self.grid is not None and min(self.grid) < 2:
            raise InputError(f"--grid takes numbers of elevations and azimuths, each at least 2, got {self.grid}")
        for name, value in (("every", self.every), ("station", self.station), ("subcarriers", self.subcarriers)):
            if value is not None and value < 1:
                raise InputError(f"--{name} must be at least 1, got {value}")

    def _check_array(self, *array: float) -> None:
        *sides, spacing, frequency = array
        rows, columns = (int(side) for side in (sides[0], sides[-1]))
        if not (1 <= min(rows, columns) <= max(rows, columns) <= MAX_SIDE and max(rows, columns) >= 2):
            raise InputError(f"--array takes 2 to {MAX_SIDE} elements a side, got {rows} x {columns}")
        if min(spacing, frequency) <= 0:
            raise InputError(
                f"--array takes a spacing [m] and a carrier [Hz] above 0, got {spacing:g} and {frequency:g}"
            )


@dataclass(frozen=True, kw_only=True)
class TableSource(Options):
    """Options of reading RSSI."""

    group: ClassVar[str] = "table"

    columns: tuple[str, ...] = ()
    """names of columns of a survey table that are not recognised: x=NAME y=NAME receiver=NAME rssi=NAME
    floor=NAME ... (several with rssi='WAP*')"""
    filler: tuple[float, ...] = ()
    """values of RSSI that stand for not detected (default: those that are recognised)"""
    keep_filler: bool = False
    """count all values of RSSI as measured"""
    coordinates: Literal["degrees", "metres"] | None = None
    """unit of the positions in a survey table (default: the one that is recognised)"""
    transmitter: tuple[str, ...] = ()
    """columns of a survey table with the position of the transmitter, where both ends move: x y [z]; or the one column with
    names of its positions, which receivers.csv contains (default: those that are recognised, e.g. tx_x tx_y)"""
    pool_by: str | None = None
    """pool radios of one access point into one receiver, by the mean of their powers: mac (the first five bytes of their
    addresses), a regular expression whose group is the access point, or the column of a long table that contains it"""

    @property
    def column_names(self) -> dict[str, str] | None:
        """Names of columns by role, None if there are none."""
        return {role: name for role, _, name in (text.partition("=") for text in self.columns)} or None

    def check(self) -> None:
        super().check()
        for text in self.columns:
            role, _, name = text.partition("=")
            if not role or not name:
                raise InputError(f"--columns takes what a column holds and its name, e.g. x=NAME, got {text!r}")
        if len(self.column_names or {}) < len(self.columns):
            raise InputError(f"--columns names something twice: {' '.join(self.columns)}")
        if len(self.transmitter) > 3:
            raise InputError(f"--transmitter takes 1 to 3 columns, got {' '.join(self.transmitter)}")
        if self.filler and self.keep_filler:
            raise InputError("--filler and --keep-filler exclude each other")

    @property
    def fillers(self) -> tuple[float, ...] | None:
        """Values that stand for not detected, none with --keep-filler. None for those that are recognised."""
        return self.filler if self.filler or self.keep_filler else None


@dataclass(frozen=True, kw_only=True)
class OffsetSource(TableSource):
    """Options of reading RSSI of several devices or channels."""

    offset_by: str | None = None
    """column of a survey table with groups of rows, e.g. devices, whose constant offsets are estimated; COLUMN=VALUE makes
    that group the reference of maps (default: the most frequent one)"""

    @property
    def reference(self) -> str | None:
        """Group whose offset is 0, None for the most frequent one."""
        return None if self.offset_by is None else self.offset_by.partition("=")[2] or None

    def check_used(self, data: str | None) -> None:
        """Refuse options of reading RSSI without measured data.

        Raises:
            InputError: Such an option, but no data.
        """
        if data is None and (names := given(self, TableSource, OffsetSource)):
            raise InputError(f"--{names[0]} is for measured RSSI; give it with --data")


def given(config: Options, *groups: type[Options]) -> list[str]:
    """Return the names of the options that are set, of those that these classes add to their bases.

    Example:
        >>> given(SpectraSource(every=2, drop_null=True), SpectraSource)
        ['every', 'drop-null']
    """
    default = {option.name: option.default for option in fields(config)}
    names = [name for group in groups for name in get_annotations(group) if name in default]
    return [name.replace("_", "-") for name in names if getattr(config, name) != default[name]]
