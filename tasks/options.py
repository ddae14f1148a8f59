"""Options of commands: groups that they share, and the checks that need no data. Importable without torch."""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, fields, is_dataclass
from functools import lru_cache
from inspect import getsource
from itertools import pairwise
from os.path import isdir  # unlike Path.is_dir, it is False for names that are too long
from pathlib import Path
from sys import modules
from types import NoneType
from typing import Annotated, Any, ClassVar, Literal, TypeVar, Union, dataclass_transform, get_args, get_type_hints
from unicodedata import category

import tyro
from annotated_types import Ge, Lt

from swiftwrf.errors import InputError
from swiftwrf.runtime.registry import Registry
from swiftwrf.runtime.validation import PositiveFloat, PositiveInt, check_value
from tasks import labels

# other spellings of options, on the command line and in files of options
ALIASES = {"mix": "measured", "synthesizer": "models", "rx": "receivers"}
READING = "reading.yaml"  # name of the file beside measurements that states how to read them
SEEDS = 2**32  # number of seeds that the generators of scikit-learn and NumPy accept
Seed = Annotated[int, Ge(0), Lt(SEEDS)]
MAX_SIDE = 32  # elements: spectra of 32 x 32 elements have 7,938 independent numbers

Class = TypeVar("Class", bound=type)


@dataclass_transform(frozen_default=True)
def options(cls: Class) -> Class:
    """Make a class a frozen dataclass of options. The text below each one is its help."""
    hints = get_type_hints(cls, include_extras=True)
    for option, text in _texts(cls).items():
        hint = hints[option]
        if not any(hasattr(extra, "help_behavior_hint") for extra in get_args(hint)):
            others = [f"--{other}" for other, name in ALIASES.items() if name == option]
            hint = Annotated[hint, tyro.conf.arg(help=text, help_behavior_hint=_default, aliases=others or None)]
        cls.__annotations__[option] = hint
    dataclass(frozen=True)(cls)
    return cls


def _texts(cls: type[Any]) -> dict[str, str]:
    """Return the text below each field that a class of a module declares, by its name."""
    parts = pairwise(_classes(cls.__module__)[cls.__name__].body)
    return {
        ast.unparse(one.target): " ".join(str(ast.literal_eval(other.value)).split())
        for one, other in parts
        if isinstance(one, ast.AnnAssign) and isinstance(other, ast.Expr)
    }


@lru_cache
def _classes(module: str) -> dict[str, ast.ClassDef]:
    """Return the classes of a module by name. The source is parsed once, which takes half the time of a help."""
    tree = ast.parse(getsource(modules[module]))
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


def _default(value: str) -> str:
    """Return the text of a default in the help, which is empty for None, False and no values."""
    return "" if value in ("None", "False", "") else f"(default: {value})"


def _without_none(hint: Any) -> Any:
    """Return the type of an option that is given."""
    kinds = get_args(get_args(hint)[0]) if hasattr(hint, "__metadata__") else ()
    return Union[tuple(kind for kind in kinds if kind is not NoneType)] if NoneType in kinds else hint  # noqa: UP007


def by_name(config: Any) -> dict[str, Any]:
    """Return the options of a command as plain values by name, those of its groups included.

    Example:
        >>> by_name(General(json=True))
        {'config': None, 'verbose': False, 'quiet': False, 'json': True, 'open': False}
    """
    values: dict[str, Any] = {}
    for option in fields(config):
        value = getattr(config, option.name)
        values |= by_name(value) if is_dataclass(value) else {option.name: value}
    return values


def meanings(config_type: type[Any]) -> dict[str, str]:
    """Return the help of each option that a class declares, by its name on the command line."""
    return {f"--{name.replace('_', '-')}": text for name, text in _texts(config_type).items()}


@dataclass(frozen=True)
class General:
    """Options that every command has. They change no result."""

    config: str | None = None
    """FILE.yaml or FILE.json with options by name, e.g. the config.json of a run; options of the command line win"""
    verbose: bool = False
    """print what is read and computed, with times"""
    quiet: bool = False
    """print the answer only, no progress and no notes"""
    json: bool = False
    """print the answer as one JSON object, and nothing else"""
    open: bool = False
    """open the report or page of the command in the browser"""


@options
class Options:
    """Base class of the options of a command. The docstring of a subclass is the description in its help.

    A field that is a dataclass is a group of the help. `check` runs before the modules of the command are imported, so a
    wrong value is refused at once.
    """

    opens: ClassVar[bool] = True  # whether --open has something to show
    _: KW_ONLY

    @property
    def endless(self) -> bool:
        """True for a command that runs until it is stopped."""
        return False

    def check(self) -> None:
        """Refuse options that are wrong whatever the data. Subclasses extend it.

        Raises:
            InputError: Empty text, control characters, or a number that is not finite or outside its declared range.
        """
        hints = get_type_hints(type(self), include_extras=True)
        for option in fields(self):
            given, flag = getattr(self, option.name), f"--{option.name.replace('_', '-')}"
            if isinstance(given, Options):
                given.check()
                continue
            for value in given if isinstance(given, tuple) else (given,):
                if value == "":
                    raise InputError(f"{flag} is empty; give it a value or leave it out")
                if isinstance(value, str) and any(category(letter) in ("Cc", "Cs") for letter in value):
                    raise InputError(
                        f"{flag} {value!a} holds control characters or is not UTF-8; give it another value"
                    )
                if isinstance(value, float) and not math.isfinite(value):
                    raise InputError(f"{flag} takes finite numbers, got {value}")
            if given is not None:
                check_value(flag, given, _without_none(hints[option.name]))


def choice(
    meaning: str, registry: Registry[Any] | None, known: Mapping[str, labels.Label], default: str, *aliases: str
) -> Any:
    """Return the annotation of an option that takes names of a registry, or of `known`. Its help lists the names."""

    def entries(_: str) -> str:
        names = {name: label.meaning for name, label in known.items()}
        names = names if registry is None else labels.meanings(registry, known)
        return f"{'; '.join(f'{name}: {meaning}' for name, meaning in names.items())} (default: {default})"

    return tyro.conf.arg(help=f"{meaning}:", help_behavior_hint=entries, aliases=aliases or None)


def pairs(option: str, texts: tuple[str, ...], role: str) -> dict[str, str] | None:
    """Return the names in an option that takes ROLE=NAME, by role, None if there are none. A role is the example.

    Raises:
        InputError: A role without a name, or named twice.
    """
    found = {role: name for role, _, name in (text.partition("=") for text in texts)}
    if "" in (*found, *found.values()):
        raise InputError(f"--{option} takes {option} and their names, e.g. {role}=NAME, got {' '.join(texts)}")
    if len(found) < len(texts):
        raise InputError(f"--{option} names something twice: {' '.join(texts)}")
    return found or None


@options
class ReadingOptions(Options):
    """Options of reading: what the files of measurements leave open."""

    array: tuple[int, float, float] | tuple[int, int, float, float] | None = None
    """array of the spectra if the data do not describe it, or for which spectra of ray paths are computed: elements a side,
    spacing [m], carrier [Hz] of a square array, or rows, columns, spacing [m], carrier [Hz]"""
    arrays: tuple[str, ...] = ()
    """names of the arrays in a file of array snapshots that are not those of snapshots.npz: csi=NAME position=NAME
    frequency_hz=NAME ..."""
    beamformer: Annotated[str | None, choice("beamformer for array snapshots", None, labels.BEAMFORMERS, "phase")] = (
        None
    )
    grid: tuple[int, int] | None = None
    """elevations and azimuths of computed spectra, 1 elevation for a ring in the plane of the array (default: 90 360)"""
    every: PositiveInt | None = None
    """reads one measurement of that many"""
    station: PositiveInt | None = None
    """number of the array in a file with several, counted from 1"""
    subcarriers: PositiveInt | None = None
    """number of subcarriers at which the channel is computed from ray paths (default: spectra alone)"""
    bandwidth: PositiveFloat | None = None
    """distance of the first and the last of these subcarriers [Hz]"""
    drop_null: bool = False
    """leave out null subcarriers of array snapshots, which are the same at every position and element"""
    drop_elements: tuple[int, ...] = ()
    """leave out these elements of the array, counted from 0"""
    round_trip: bool = False
    """phases of array snapshots are those of the way there and back, as of RFID and backscatter"""
    sender: str | None = None
    """hardware address of the sender whose packets are used, of captures with several (default: the most frequent one)"""
    columns: tuple[str, ...] = ()
    """names of columns of a survey table that are not recognised: x=NAME y=NAME receiver=NAME rssi=NAME
    floor=NAME ... (several with rssi='WAP*')"""
    filler: tuple[float, ...] | Literal["none"] = ()
    """values of RSSI that stand for not detected; none counts all as measured (default: those that are recognised)"""
    coordinates: Literal["degrees", "metres"] | None = None
    """unit of the positions in a survey table (default: the one that is recognised)"""
    transmitter: tuple[str, ...] = ()
    """columns of a survey table with the position of the transmitter, where both ends move: x y [z]; or the one column with
    names of its positions, which receivers.csv contains (default: those that are recognised, e.g. tx_x tx_y)"""
    pool_by: str | None = None
    """pool radios of one access point into one receiver, by the mean of their powers: mac (the first five bytes of their
    addresses), a regular expression whose group is the access point, or the column of a long table that contains it"""
    scale: PositiveFloat | None = None
    """pixels of a floor plan, or other units of x and y in a survey table, in a metre (default: as lines above the header or
    names of columns state)"""
    y_down: bool = False
    """y of a survey table points down, as in images of floor plans"""
    up: Literal["y", "z"] = "z"
    """axis of a survey table that points up: y as in ARCore, ARKit and Unity"""
    window: PositiveFloat | None = None
    """join packets of several receivers in windows of this length [s] to one row each, by their means"""
    quantity: str | None = None
    """what the values of a survey table are, if not RSSI: throughput, latency, SNR, ... Maps then have no path loss and no
    limit of detection. Needs --unit, and --columns rssi=NAME unless one column is named so"""
    unit: str | None = None
    """unit of --quantity; or of RSSI, if it is not dBm: percent (percent / 2 - 100 dBm), or positive (dBm without sign)"""
    receiver_positions: str | None = None
    """table with positions of the receivers of a survey table (default: receivers.csv beside it)"""
    offset_by: str | None = None
    """column of a survey table with groups of rows, e.g. devices, whose constant offsets are estimated; COLUMN=VALUE makes
    that group the reference of maps (default: the most frequent one)"""

    @property
    def given(self) -> dict[str, Any]:
        """Options that are not the defaults, as values of a YAML file by name.

        Example:
            >>> ReadingOptions(grid=(15, 60), drop_null=True).given
            {'grid': [15, 60], 'drop_null': True}
        """
        values = {option.name: getattr(self, option.name) for option in fields(self)}
        given = {option.name: values[option.name] for option in fields(self) if values[option.name] != option.default}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in given.items()}

    def check(self) -> None:
        """Refuse options that are wrong whatever the data.

        Raises:
            InputError: An unknown beamformer, an array that is none, or a name that is missing or given twice.
        """
        super().check()
        pairs("arrays", self.arrays, "csi")
        if self.beamformer is not None and self.beamformer not in labels.BEAMFORMERS:
            raise InputError(f"unknown beamformer {self.beamformer!r}; choose from {', '.join(labels.BEAMFORMERS)}")
        if self.array is not None:
            *sides, spacing, frequency = self.array
            rows, columns = (int(side) for side in (sides[0], sides[-1]))
            if not (1 <= min(rows, columns) <= max(rows, columns) <= MAX_SIDE and max(rows, columns) >= 2):
                raise InputError(f"--array takes 2 to {MAX_SIDE} elements a side, got {rows} x {columns}")
            if min(spacing, frequency) <= 0:
                raise InputError(
                    f"--array takes a spacing [m] and a carrier [Hz] above 0, got {spacing:g} and {frequency:g}"
                )
        if self.grid is not None and (self.grid[0] < 1 or self.grid[1] < 2):
            raise InputError(
                f"--grid takes numbers of elevations, 1 for a ring, and of azimuths, at least 2, got {self.grid}"
            )
        pairs("columns", self.columns, "x")
        if len(self.transmitter) > 3:
            raise InputError(f"--transmitter takes 1 to 3 columns, got {' '.join(self.transmitter)}")
        if self.offset_by is not None and self.offset_by.startswith("="):
            raise InputError(f"--offset-by takes COLUMN or COLUMN=VALUE, got {self.offset_by!r}")


@options
class ReadingConfig(Options):
    """Options of a command that reads measurements."""

    _: KW_ONLY
    read: str | None = None
    """FILE.yaml with options of reading, which swiftwrf inspect writes (default: reading.yaml beside the data, if there is
    one)"""

    def check_read(self) -> None:
        """Refuse a file of reading options without measurements.

        Raises:
            InputError: --read, but no --data.
        """
        if self.read is not None and getattr(self, "data", None) is None:
            raise InputError("--read states how --data is read; give both")


@options
class FindingConfig(ReadingConfig):
    """Options of a command that finds out how measurements are to be read."""

    _: KW_ONLY
    reading: ReadingOptions = ReadingOptions()


def beside(source: Path) -> Path:
    """Return the file beside measurements that holds their options of reading.

    Example:
        >>> beside(Path("walk.csv"))
        PosixPath('walk.csv.reading.yaml')
    """
    return source / READING if isdir(source) else source.with_name(f"{source.name}.{READING}")
