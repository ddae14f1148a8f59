"""Tensors and plain values in one safetensors file, written whole or not at all; opening one never runs code."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from swiftwrf.errors import InputError

FORMAT = 1


def write(path: str | Path, kind: str, tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    """Writes under a temporary name and renames, so that an interrupted write leaves the old file.

    Args:
        path: of the file.
        kind: what the file holds; `read` refuses another kind.
        tensors: by name.
        header: values that JSON can carry.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    metadata = {"kind": kind, "format": str(FORMAT), "header": json.dumps(header)}
    try:
        save_file({name: t.detach().cpu().contiguous() for name, t in tensors.items()}, temporary, metadata)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read(path: str | Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and header of a file of the given kind.

    Raises:
        InputError: no such file, not a safetensors file, another kind or a newer format.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path} is not a readable safetensors file ({error})") from None
    if metadata.get("kind") != kind or metadata.get("format") != str(FORMAT):
        raise InputError(
            f"{path} holds {metadata.get('kind', 'something else')!r} in format {metadata.get('format')}; "
            f"expected {kind!r} in format {FORMAT}"
        )
    return tensors, json.loads(metadata["header"])
