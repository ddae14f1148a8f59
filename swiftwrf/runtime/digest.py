"""Digests of data, options and code: a kept result is continued only by a call that equals the one it began with."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cached_property
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from torch import Tensor

from swiftwrf.errors import InputError

PLAIN = (type(None), bool, int, float, complex, str, bytes)
# packages whose code changes with their version
OF_VERSIONS = {*sys.stdlib_module_names, "swiftwrf", "augment", "tasks"}


def digest(*values: Any) -> str:
    """Return the SHA-256 of values by their content, equal in every process.

    Functions and classes count by their code and by what it names, those of installed packages by their names alone.

    Raises:
        InputError: A value such as an open file, which cannot be compared with one of another process.

    Example:
        >>> digest([1.0], {"seed": 0}) == digest([1.0], {"seed": 0}) != digest([1.0], {"seed": 1})
        True
    """
    found = hashlib.sha256()
    try:
        _add(values, found, set())
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"results of these values cannot be kept ({error}); leave keep out") from None
    return found.hexdigest()


def _add(value: Any, found: Any, seen: set[int]) -> None:
    """Add a value to a hash. `seen` are the values around it, and all functions and classes before it."""
    found.update(f"{'list' if isinstance(value, tuple) else type(value).__qualname__} ".encode())
    if isinstance(value, PLAIN):
        found.update(repr(value).encode())
    elif id(value) not in seen:
        seen.add(id(value))
        parts = _content(value)
        found.update(parts if isinstance(parts, bytes) else f"{len(parts)}:".encode())
        for part in () if isinstance(parts, bytes) else parts:
            _add(part, found, seen)
        if not isinstance(value, type | FunctionType):
            seen.remove(id(value))


def _content(value: Any) -> bytes | list[Any]:
    """Return the bytes of a value, or the values that determine it."""
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        return repr((value.dtype.str, value.shape)).encode() + value.tobytes()
    if hasattr(value, "tolist"):
        return [getattr(value, "name", None), value.tolist()]
    if isinstance(value, Mapping):
        return [*value.items()]
    if isinstance(value, list | tuple):
        return [*value]
    if isinstance(value, set | frozenset):
        return sorted(map(digest, value))
    if isinstance(value, ModuleType):
        return value.__name__.encode()
    if isinstance(value, type | FunctionType) and not _is_own(value):
        return f"{value.__module__}.{value.__qualname__}".encode()
    if isinstance(value, type):
        members = {name: x for name, x in vars(value).items() if callable(x) or not name.startswith(("__", "_abc_"))}
        return [value.__qualname__, *value.__mro__[1:], [(name, members[name]) for name in sorted(members)]]
    if isinstance(value, FunctionType):
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        named = {name: value.__globals__[name] for name in _names(value.__code__) if name in value.__globals__}
        return [value.__code__, value.__defaults__, value.__kwdefaults__, cells, named]
    if isinstance(value, CodeType):
        return [value.co_code, value.co_names, value.co_consts]
    if isinstance(value, property | cached_property | staticmethod | classmethod):
        return [getattr(value, name, None) for name in ("fget", "fset", "func", "__func__")]
    if callable(own := getattr(value, "digest", None)):  # of spectra, which exceed the memory
        return str(own()).encode()
    if is_dataclass(value):  # without what its properties have cached
        return [type(value), *(getattr(value, field.name) for field in fields(value))]
    parts = value.__reduce_ex__(4)  # as pickle takes the value apart: class, state, items
    return parts.encode() if isinstance(parts, str) else [*parts[:3], *map(list, filter(None, parts[3:]))]


def _names(code: CodeType) -> list[str]:
    """Return the names in a code and in the functions inside it."""
    inside = [part for part in code.co_consts if isinstance(part, CodeType)]
    return sorted({*code.co_names}.union(*map(_names, inside)))


def _is_own(code: Any) -> bool:
    """Return True for a function or class of a notebook or a module of the user, which changes without a version."""
    name = str(code.__module__)
    file = "" if name == "__main__" else getattr(sys.modules.get(name), "__file__", None) or ""
    return name.partition(".")[0] not in OF_VERSIONS and "site-packages" not in file
