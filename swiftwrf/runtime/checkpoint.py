"""Tensors and plain values in one safetensors file, written whole or not at all; opening one never runs code.

Every fitted model is saved and opened the same way: it derives from `Saved`, and `load` opens any of them.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from swiftwrf.errors import InputError
from swiftwrf.runtime.durable import write_bytes

FORMAT = 1
Header = dict[str, Any]  # values that JSON can carry


def write(path: str | Path, kind: str, tensors: dict[str, Tensor], header: Header) -> None:
    """Writes the file, or leaves the old one where the write is interrupted.

    Args:
        path: of the file.
        kind: what the file holds; `read` refuses another kind.
        tensors: by name.
        header: values that JSON can carry.
    """
    metadata = {"kind": kind, "format": str(FORMAT), "header": json.dumps(header)}
    content = save({name: t.detach().cpu().contiguous() for name, t in tensors.items()}, metadata)
    write_bytes(Path(path), content)


def read(path: str | Path, *kinds: str) -> tuple[str, dict[str, Tensor], Header]:
    """Kind, tensors and header of a file of one of the given kinds.

    Raises:
        InputError: no such file, not a safetensors file, another kind or a newer format, or a number that is not finite.
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
            for name, tensor in tensors.items():
                if not bool(torch.isfinite(tensor).all()):
                    raise InputError(
                        f"{path}: {name} holds a value that is not finite, so nothing it gives can be trusted; make it anew"
                    )
    except InputError:
        raise
    except (OSError, SafetensorError, ValueError, RecursionError, RuntimeError, TypeError) as error:
        raise InputError(f"{path} is not a readable safetensors file of this package ({error})") from None
    if not isinstance(header, dict):
        raise InputError(f"{path} has no header of names and values; it was changed or written by something else")
    return kind, tensors, header


def expect(tensors: dict[str, Tensor], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Refuses tensors that are not there or of another shape than the header calls for.

    What a header says is believed only after this: it may ask for gigabytes, the tensors lie in the file.

    Raises:
        InputError: the first such tensor.
    """
    for name, shape in shapes.items():
        if name not in tensors:
            raise InputError(f"{name} is missing")
        if tuple(tensors[name].shape) != shape:
            raise InputError(f"{name} has shape {tuple(tensors[name].shape)}, but the configuration calls for {shape}")


class Saved(ABC):
    """A fitted model that one file can hold; subclasses name their kind and are known to `load` from then on."""

    kind: ClassVar[str]
    kinds: ClassVar[dict[str, type[Saved]]] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "kind" in cls.__dict__:
            Saved.kinds[cls.kind] = cls

    @abstractmethod
    def state(self) -> tuple[dict[str, Tensor], Header]:
        """Tensors by name, and plain values."""

    @classmethod
    @abstractmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> Saved:
        """The model of which `state` gave these.

        Raises:
            InputError: they do not fit together; found before memory is taken for what the header claims.
        """

    def save(self, path: str | Path, provenance: dict[str, str] | None = None) -> None:
        """Writes the model to one safetensors file, its configuration and `provenance` in the header."""
        tensors, header = self.state()
        write(path, self.kind, tensors, header | {"provenance": provenance or {}})


def load(path: str | Path) -> Saved:
    """The model that was saved there, of whatever kind.

    Raises:
        InputError: not such a file, or one whose parts do not fit together.
    """
    return restore(path, *Saved.kinds)[0]


def restore(path: str | Path, *kinds: str) -> tuple[Saved, Header]:
    """The model that was saved there, of one of these kinds, and its header: the one way in for all of them.

    Raises:
        InputError: not such a file, or one whose parts do not fit together.
    """
    kind, tensors, header = read(path, *kinds)
    with refusing(f"{path} is no {kind} that can be used"):
        return Saved.kinds[kind].from_state(tensors, header), header


@contextmanager
def refusing(what: str) -> Iterator[None]:
    """Says that what was kept on disk does not fit together, whatever part of it shows it first."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        raise InputError(f"{what}: {reason}; it was changed or written by another version, make it anew") from None
