"""Files that are whole or not there, whatever happens while they are written: an error, a kill, a full disk, a power cut.

A file is written under a temporary name, brought to the disk (fsync) and renamed; then its directory is brought to the
disk, for a rename lives there. Without the first fsync a power cut may leave the new name with no content; without the
second the old file.
"""

from __future__ import annotations

import errno
import json
import math
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from swiftwrf.errors import InputError

# directories without read permission, directories on Windows, network file systems that cannot fsync a directory
UNSUPPORTED = {errno.EACCES, errno.EPERM, errno.EINVAL, errno.ENOTSUP}


def cache_folder() -> Path:
    """Return the folder of files that can be recomputed: `$XDG_CACHE_HOME/swiftwrf`, or `~/.cache/swiftwrf`.

    Raises:
        InputError: The user has no home directory.
    """
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "swiftwrf"
    except RuntimeError:
        raise InputError("there is no home directory for the cache; set XDG_CACHE_HOME to a directory") from None


@contextmanager
def refusing_unwritable(folder: Path) -> Iterator[None]:
    """Raise InputError if a folder of the cache cannot be written."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"{folder} of the cache cannot be written ({error.strerror}); set XDG_CACHE_HOME to another directory"
        ) from None


def sync(path: Path) -> None:
    """Bring the content of a file, or the names in a directory, to the disk, where the file system can.

    Raises:
        OSError: The write failed, e.g. because the disk is full.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in UNSUPPORTED:
            raise


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary file beside `path`, which replaces `path` at the end of the block unless it raises."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}")  # of this call alone
    try:
        yield temporary
        sync(temporary)
        rename(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file; an error leaves the old one."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path, content: str) -> None:
    """Write a file in UTF-8; an error leaves the old one."""
    write_bytes(path, content.encode())


def rename(source: Path, target: Path) -> None:
    """Rename a file or directory within its directory, and wait until the disk has it."""
    os.replace(source, target)
    sync(target.parent)


def strict(value: Any) -> Any:
    """Return the value as strict JSON carries it: nan and infinity become None, keys become text.

    Example:
        >>> strict({1: (0.5, float("nan"))})
        {'1': [0.5, None]}
    """
    if isinstance(value, dict):
        return {str(key): strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [strict(item) for item in value]
    if hasattr(value, "tolist"):  # tensors and arrays
        return strict(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_json(file: Path, content: Any) -> None:
    """Write a value as strict JSON."""
    write_text(file, json.dumps(strict(content), indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def write_npz(file: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays by name."""
    import numpy as np

    with replacing(file) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)
