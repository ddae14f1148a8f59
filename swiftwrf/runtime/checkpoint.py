"""Model files: tensors and plain values in one safetensors file, written atomically; opening one never runs its code.

Every fitted model derives from `Saved`, and `load` opens any of them. A file contains a tree: models and dataclasses, lists
and tuples of these, networks, tensors and plain values. `pack` turns a tree into tensors by their dotted names and a header
of plain values. `unpack` builds the tree of an annotation from them and checks each value against its annotation.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from importlib import import_module
from importlib.metadata import entry_points
from inspect import isclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Self, Union, get_args, get_origin

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from swiftwrf.errors import CONTENT_ERRORS, InputError
from swiftwrf.runtime.durable import write_bytes
from swiftwrf.runtime.validation import RANGES, Configured, check_value, checked, hints_of

FORMAT = 2  # of files, which is raised when earlier ones cannot be read
Header = dict[str, Any]  # values that JSON can store


def write(path: str | Path, kind: str, tensors: dict[str, Tensor], header: Header) -> None:
    """Write a file atomically: an interrupted write leaves the old file. `read` refuses another kind of content."""
    plain, storages = dict[str, Tensor](), set[int]()
    for name, tensor in tensors.items():
        value = tensor.detach().cpu().contiguous()
        is_shared = value.untyped_storage().data_ptr() in storages  # one tensor with two names, which is stored twice
        plain[name] = value.clone() if is_shared else value
        storages.add(value.untyped_storage().data_ptr())
    metadata = {"kind": kind, "format": str(FORMAT), "header": json.dumps(header)}
    write_bytes(Path(path), save(plain, metadata | {"sha256": _digest(plain, metadata)}))


def _digest(tensors: dict[str, Tensor], metadata: dict[str, str]) -> str:
    """Return the SHA-256 of all tensors and of the metadata beside it."""
    described = {name: (str(t.dtype), list(t.shape)) for name, t in tensors.items()}
    digest = hashlib.sha256(json.dumps([described, metadata], sort_keys=True).encode())
    for name in sorted(tensors):
        digest.update(tensors[name].flatten().view(torch.uint8).numpy().data)
    return digest.hexdigest()


def check_folder(path: str | Path, what: str) -> None:
    """Refuse a file in a folder that does not exist.

    Raises:
        InputError: There is no such folder; the message names what the file holds.
    """
    if not Path(path).parent.is_dir():
        raise InputError(f"the folder of the {what} {path} does not exist; create it")


def read(path: str | Path, *kinds: str) -> tuple[str, dict[str, Tensor], Header]:
    """Return kind, tensors and header of a file of one of the given kinds.

    Raises:
        InputError: No such file, not a safetensors file, another kind or a newer format, content that is not as it was
            written, or a value that is not finite.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            kind = metadata.get("kind", "something else")
            if kind not in kinds or metadata.get("format") != str(FORMAT):
                raise InputError(
                    f"{path} holds {kind!r} in format {metadata.get('format')}; expected "
                    f"{' or '.join(map(repr, kinds))} in format {FORMAT}"
                )
            header = json.loads(metadata.get("header", ""))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
            if metadata.pop("sha256", None) != _digest(tensors, metadata):
                raise InputError(f"{path} is damaged: its content is not what was written; create the file again")
            for name, tensor in tensors.items():
                if not bool(torch.isfinite(tensor).all()):
                    raise InputError(f"{path}: {name} holds a value that is not finite; create the file again")
    except InputError:
        raise
    except (OSError, SafetensorError, ValueError, RecursionError, RuntimeError, TypeError) as error:
        raise InputError(f"{path} is not a readable safetensors file of this package ({error})") from None
    if not isinstance(header, dict):
        raise InputError(f"{path} has no header of names and values; it was changed or written by something else")
    return kind, tensors, header


class Saved(Configured, ABC):
    """Base class of fitted models that one file stores. A subclass with a `kind` is registered for `load`.

    A subclass names in `saved` what `fit` sets, and annotates it. For example, `saved = "mean"` with
    `mean: Annotated[Tensor, "float64 n 3"]`; see `unpack` for annotations. A name may also be that of a property with a
    setter, whose result is annotated. A class with a network has a method `blank`. It takes the tensors of the network by
    name and returns a network of the same shapes, whose weights take no memory.
    """

    kind: ClassVar[str]
    kinds: ClassVar[dict[str, type[Saved]]] = {}
    saved: ClassVar[str] = ""
    """attributes that a file contains besides the options and those of the base classes, in the order of reading"""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "kind" in cls.__dict__:
            Saved.kinds[cls.kind] = cls

    def state(self) -> tuple[dict[str, Tensor], Header]:
        """Return the tensors by name, and plain values.

        Raises:
            InputError: The model is not fitted, or its class does not annotate an attribute that it names in `saved`.
        """
        self.check_fitted()
        for name in _names(type(self)):
            _annotation(type(self), name)
        return pack(self)

    @classmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> Self:
        """Return the model that `state` describes.

        Raises:
            InputError: Tensors and header do not match. No memory is allocated for sizes that only the header claims.
        """
        model: Self = unpack(cls, tensors, header)
        return model

    def _restored(self) -> None:
        """Compute what follows from the attributes of a file, and refuse those that do not fit together."""

    @checked
    def save(self, path: str | Path, provenance: dict[str, str] | None = None) -> None:
        """Write the model to one safetensors file.

        Args:
            path: File to write.
            provenance: Additional texts for the header, e.g. data set and commit.

        Raises:
            InputError: The model is not fitted, or the folder of the file does not exist.
        """
        check_folder(path, self.kind)
        tensors, header = self.state()
        write(path, self.kind, tensors, header | {"provenance": provenance or {}})


def pack(value: Any, name: str = "") -> tuple[dict[str, Tensor], Any]:
    """Return the tensors of a tree by their dotted names, and the rest as values that JSON can store.

    In a tensor, the largest number of its type stands for nan, because a file contains finite values only.

    Example:
        >>> from swiftwrf.gp import GaussianProcess, Kernel
        >>> tensors, header = pack(GaussianProcess(Kernel(), torch.zeros(2, 3)))
        >>> sorted(tensors), header["kernel"]["noise"]
        (['correlation', 'known', 'value'], 0.01)
        >>> unpack(GaussianProcess, tensors, header).kernel == Kernel()
        True
    """
    if isinstance(value, Tensor):
        if value.is_floating_point() and bool((gap := value.isnan()).any()):
            value = value.masked_fill(gap, torch.finfo(value.dtype).max)
        return {name: value}, {}
    if isinstance(value, nn.Module):
        return {_joined(name, of): tensor for of, tensor in value.state_dict().items()}, {}
    if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        parts = {str(number): pack(part, _joined(name, str(number))) for number, part in enumerate(value)}
        header: Any = [plain for _, plain in parts.values()]
    elif isinstance(value, Saved | tuple) or is_dataclass(value):
        parts = {part: pack(getattr(value, part), _joined(name, part)) for part in _names(type(value))}
        header = {part: plain for part, (_, plain) in parts.items()}
    else:
        return {}, value
    return {of: tensor for tensors, _ in parts.values() for of, tensor in tensors.items()}, header


def unpack(
    kind: Any, tensors: Mapping[str, Tensor], header: Any, name: str = "", sizes: dict[str, int] | None = None
) -> Any:
    """Return the tree of an annotation from what `pack` returned.

    The annotation of a tensor contains its type and sizes, and bounds of its values, e.g.
    `Annotated[Tensor, "float64 n 3", Gt(0)]`. The type is one or several, separated by a bar. `float` is any floating-point
    type. A size is a number or a name, or a sum such as `1+n`. Equal names in one model or dataclass are equal sizes. A name
    may be that of a whole number read before. `part.n` is the n of a part read before, e.g. `grid.n_azimuth`. The last word
    `nan` allows nan.

    Such a text also gives the length of a list or tuple. For a dataclass, `Annotated[Part, "k=n"]` states that the k of the
    part is the n of the whole, and `"n"` that both have one n. Of several dataclasses the names decide. Other annotations
    are those of `check_value`.

    Args:
        kind: Annotation.
        tensors: Tensors by name; other names are ignored.
        header: Plain values.
        name: Dotted name of the tree in the file.
        sizes: Sizes by their dotted names, filled while the file is read.

    Raises:
        InputError: A value is missing, or its annotation does not allow it.
    """
    sizes = {} if sizes is None else sizes
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated and arguments[0] is Tensor:
        return _tensor(arguments[1:], tensors, name, sizes)
    if origin is Annotated and isinstance(arguments[1], str):
        kind, words, parent = arguments[0], arguments[1].split(), name.rpartition(".")[0]
        if is_dataclass(kind):
            pairs = (word.split("=") for word in words)
            sizes |= {_joined(name, pair[0]): sizes[_joined(parent, pair[-1])] for pair in pairs}
            return unpack(kind, tensors, header, name, sizes)
        value = unpack(kind, tensors, header, name, sizes)
        _check_shape(name, (len(value),), words, sizes)
        return value
    if origin in (Union, UnionType):
        kinds = [of for of in arguments if of is not NoneType]
        if header is None and len(kinds) < len(arguments):
            return None
        if len(kinds) > 1 and isinstance(header, dict):
            kinds = [of for of in kinds if header.keys() <= {*_names(of)}]
        if len(kinds) == 1:
            return unpack(kinds[0], tensors, header, name, sizes)
    if origin in (list, tuple):
        kinds = [arguments[0]] * len(header) if origin is list or arguments[-1] is ... else [*arguments]
        parts = zip(kinds, header, strict=True)
        return origin(unpack(of, tensors, x, _joined(name, str(n)), sizes) for n, (of, x) in enumerate(parts))
    if isclass(kind) and (issubclass(kind, Saved | tuple) or is_dataclass(kind)):
        return _unpacked(kind, tensors, header, name, sizes)
    check_value(name, header, kind)
    if isinstance(header, int):
        sizes[name] = header
    return header


def _unpacked(kind: Any, tensors: Mapping[str, Tensor], header: Header, name: str, sizes: dict[str, int]) -> Any:
    """Return a named tuple, a dataclass, or a model whose attributes are read in their order."""

    def read_part(part: str) -> Any:
        return unpack(_annotation(kind, part), tensors, header[part], _joined(name, part), sizes)

    names = _names(kind)
    if not isinstance(header, dict):
        raise InputError(f"{name or 'the header'} must be a dictionary, got {header!r}")
    for part in {*names, "provenance"} ^ {*header, "provenance"}:
        raise InputError(f"{_joined(name, part)} is {'missing' if part in names else 'unknown'}")
    if not issubclass(kind, Saved):
        return kind(**{part: read_part(part) for part in names})
    model = kind(read_part(names[0]))
    for part in names[1:]:
        of = _annotation(kind, part)
        is_network = isclass(of) and issubclass(of, nn.Module)
        setattr(model, part, _network(model.blank, tensors, _joined(name, part)) if is_network else read_part(part))
    model._restored()
    return model


def _names(kind: type[Any]) -> list[str]:
    """Return the names of what a file contains of a named tuple, dataclass or model."""
    if not issubclass(kind, Saved):
        return [*kind._fields] if hasattr(kind, "_fields") else [field.name for field in fields(kind) if field.init]
    return ["config", *(name for base in reversed(kind.__mro__) for name in vars(base).get("saved", "").split())]


def _annotation(kind: Any, name: str) -> Any:
    if issubclass(kind, Saved) and name == "config":
        return kind.config_type
    known = getattr(kind, name, None)
    hints = {name: hints_of(known.fget)["return"]} if isinstance(known, property) else hints_of(kind)
    if name not in hints:
        raise InputError(f"{kind.__name__} cannot be saved; annotate its attribute {name}, which it names in `saved`")
    return hints[name]


def _joined(*names: str) -> str:
    return ".".join(filter(None, names))


def _tensor(annotation: tuple[Any, ...], tensors: Mapping[str, Tensor], name: str, sizes: dict[str, int]) -> Tensor:
    if name not in tensors:
        raise InputError(f"{name} is missing")
    (text, *bounds), tensor = annotation, tensors[name]
    kinds, *words = text.removesuffix(" nan").split()
    dtype = str(tensor.dtype).removeprefix("torch.")
    if not dtype.startswith(tuple(kinds.split("|"))):
        raise InputError(f"{name} has numbers of type {dtype}, expected {kinds}")
    _check_shape(name, tuple(tensor.shape), words, sizes)
    for bound in bounds:
        described, attribute, holds = RANGES[type(bound)]
        if not bool(holds(tensor, getattr(bound, attribute)).all()):  # type: ignore[attr-defined]
            raise InputError(f"{name} must be {described} {getattr(bound, attribute)}")
    if tensor.is_floating_point() and bool((gap := tensor == torch.finfo(tensor.dtype).max).any()):
        if not text.endswith(" nan"):
            raise InputError(f"{name} holds a value that is not finite")
        return tensor.masked_fill(gap, torch.nan)
    return tensor


def _check_shape(name: str, shape: tuple[int, ...], words: list[str], sizes: dict[str, int]) -> None:
    """Refuse a shape that the words of an annotation do not allow. New names become those of the sizes found."""

    def size(word: str, given: int) -> int:
        *added, last = word.split("+")
        constant, name_of_size = sum(map(int, added)), _joined(name.rpartition(".")[0], last)
        return constant + (int(last) if last.isdecimal() else sizes.setdefault(name_of_size, given - constant))

    wanted = [size(word, given) for word, given in zip(words, shape, strict=False)]
    if [*shape] != wanted or len(words) > len(shape):
        known = ", ".join(map(str, [*wanted, *words[len(wanted) :]]))
        raise InputError(f"{name} has shape {shape}, but the configuration calls for ({known})")


def _network(blank: Callable[[Mapping[str, Tensor]], nn.Module], tensors: Mapping[str, Tensor], name: str) -> nn.Module:
    """Return the network of a file, without gradients. No memory is allocated before its shapes are checked."""
    known = {of.removeprefix(f"{name}."): tensor for of, tensor in tensors.items() if of.startswith(f"{name}.")}
    with torch.device("meta"):
        network = blank(known)
    state = {}
    for of, empty in network.state_dict().items():
        text = " ".join(["int|float|bool", *map(str, empty.shape)])
        state[of] = _tensor((text,), tensors, _joined(name, of), {}).to(empty.dtype)
    network.load_state_dict(state, assign=True)
    return network.eval().requires_grad_(False)


def load(path: str | Path) -> Saved:
    """Open a saved model of any kind: field model, RSSI model or estimator.

    Kinds of other packages are found by the entry points of the groups `swiftwrf.models` and `swiftwrf.estimators`.

    Raises:
        InputError: Not a model file, an unknown kind, or content that does not match.

    Example:
        >>> import tempfile, swiftwrf
        >>> model = swiftwrf.make_model("nearest").fit(swiftwrf.simulated_room(n=20))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     model.save(folder + "/model.safetensors")
        ...     swiftwrf.load(folder + "/model.safetensors")
        NearestModel(fitted, 30 x 120 directions)
    """
    with suppress(OSError, SafetensorError, TypeError), safe_open(path, framework="pt") as file:
        if (file.metadata() or {}).get("kind") not in Saved.kinds:
            _import_kinds()
    kind, tensors, header = read(path, *Saved.kinds)
    with refusing(f"{path} is no {kind} that can be used"):
        return Saved.kinds[kind].from_state(tensors, header)


def _import_kinds() -> None:
    """Import all packages that define saved kinds; those of others that cannot be imported define none."""
    contrib = ("swiftwrf.contrib.published", "swiftwrf.contrib.raytraced.model")
    for package in ("swiftwrf.models", "swiftwrf.rssi", "swiftwrf.locate", *contrib):
        import_module(package)
    for point in (point for group in ("swiftwrf.models", "swiftwrf.estimators") for point in entry_points(group=group)):
        with suppress(Exception):  # code of another package may raise anything
            point.load()


@contextmanager
def refusing(what: str) -> Iterator[None]:
    """Raise InputError for any error that inconsistent content of a file causes."""
    try:
        yield
    except CONTENT_ERRORS as error:
        reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        raise InputError(f"{what}: {reason}; it was changed or written by another version, create it again") from None
