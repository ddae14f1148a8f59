"""Tensors and plain values in one safetensors file, written whole or not at all; opening one never runs code.

Every fitted model is saved and opened the same way: it derives from `Saved`, and `load` opens any of them.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from swiftwrf.durable import write_bytes
from swiftwrf.errors import InputError

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
        InputError: no such file, not a safetensors file, another kind or a newer format.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path} is not a readable safetensors file ({error})") from None
    kind = metadata.get("kind", "something else")
    if kind not in kinds or metadata.get("format") != str(FORMAT):
        raise InputError(
            f"{path} holds {kind!r} in format {metadata.get('format')}; expected {' or '.join(map(repr, kinds))} in "
            f"format {FORMAT}"
        )
    return kind, tensors, json.loads(metadata["header"])


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
        """The model of which `state` gave these."""

    def save(self, path: str | Path, provenance: dict[str, str] | None = None) -> None:
        """Writes the model to one safetensors file, its configuration and `provenance` in the header."""
        tensors, header = self.state()
        write(path, self.kind, tensors, header | {"provenance": provenance or {}})


def load(path: str | Path) -> Saved:
    """The model that was saved there, of whatever kind.

    Raises:
        InputError: not such a file.
    """
    kind, tensors, header = read(path, *Saved.kinds)
    return Saved.kinds[kind].from_state(tensors, header)
