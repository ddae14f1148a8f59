"""Model files: tensors and plain values in one safetensors file, written atomically; opening one never runs its code.

Every fitted model derives from `Saved`, and `load` opens any of them.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, ClassVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from swiftwrf.errors import CONTENT_ERRORS, InputError
from swiftwrf.runtime.durable import write_bytes
from swiftwrf.runtime.validation import checked

FORMAT = 1
Header = dict[str, Any]  # values that JSON can store


def write(path: str | Path, kind: str, tensors: dict[str, Tensor], header: Header) -> None:
    """Write a file atomically: an interrupted write leaves the old file. `read` refuses another kind of content."""
    plain = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
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
            # files of 0.3.0 have no digest
            if (known := metadata.pop("sha256", None)) is not None and known != _digest(tensors, metadata):
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


def expect(tensors: dict[str, Tensor], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse tensors that are missing or have other shapes than the header implies.

    Call it before memory is allocated for sizes from the header: a damaged header may claim gigabytes.

    Raises:
        InputError: The first such tensor.
    """
    for name, shape in shapes.items():
        if name not in tensors:
            raise InputError(f"{name} is missing")
        if tuple(tensors[name].shape) != shape:
            raise InputError(f"{name} has shape {tuple(tensors[name].shape)}, but the configuration calls for {shape}")


class Saved(ABC):
    """Base class of fitted models that one file stores. A subclass with a `kind` is registered for `load`."""

    kind: ClassVar[str]
    kinds: ClassVar[dict[str, type[Saved]]] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "kind" in cls.__dict__:
            Saved.kinds[cls.kind] = cls

    @abstractmethod
    def state(self) -> tuple[dict[str, Tensor], Header]:
        """Return tensors by name, and plain values."""

    @classmethod
    @abstractmethod
    def from_state(cls, tensors: dict[str, Tensor], header: Header) -> Saved:
        """Return the model that `state` describes.

        Raises:
            InputError: Tensors and header do not match. No memory is allocated for sizes that only the header claims.
        """

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
