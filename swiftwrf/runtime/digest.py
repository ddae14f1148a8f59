"""Digests of data, options and code: a kept result is continued only by a call that equals the one it began with."""

from __future__ import annotations

import hashlib
import pickle
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cached_property, wraps
from types import CodeType, FunctionType, ModuleType, SimpleNamespace
from typing import Any, ParamSpec, TypeVar

import numpy as np
from torch import Tensor

from swiftwrf.errors import InputError

P = ParamSpec("P")
Result = TypeVar("Result")
OF_VERSIONS = {*sys.stdlib_module_names, "swiftwrf", "augment", "tasks"}  # packages whose code changes with a version
DESCRIPTORS = (property, cached_property, staticmethod, classmethod)


def digest(*values: Any) -> str:
    """Return the SHA-256 of values by their content, equal in every process.

    A function or class counts by its code and what the code names, one of an installed package by its name.

    Raises:
        InputError: A value such as an open file, which cannot be compared with one of another process.

    Example:
        >>> digest([1.0], {"seed": 0}) == digest([1.0], {"seed": 0}) != digest([1.0], {"seed": 1})
        True
    """
    sha256 = hashlib.sha256()
    content = _Content(SimpleNamespace(write=sha256.update), protocol=4)
    content.fast = True  # without references, which equal values that are one object would have
    try:
        content.dump(values)
    except (pickle.PicklingError, AttributeError, TypeError, ValueError, RecursionError) as error:
        raise InputError(f"results of these values cannot be kept ({error}); leave keep out") from None
    return sha256.hexdigest()


def computed_once(function: Callable[P, Result]) -> Callable[P, Result]:
    """Return a function of one's own that keeps its last result, for a next call with equal arguments.

    Predictors that are compared are fitted to the same rows one after another. The result must not be changed.

    Example:
        >>> negated = computed_once(lambda values: print("computed") or -values)
        >>> negated(2), negated(2)
        computed
        (-2, -2)
    """
    last: list[tuple[str, Result]] = []

    @wraps(function)
    def wrapped(*arguments: P.args, **options: P.kwargs) -> Result:
        key = digest(arguments, options)
        for known, result in last:
            if known == key:
                return result
        result = function(*arguments, **options)
        last[:] = [(key, result)]
        return result

    return wrapped


class _Content(pickle._Pickler):
    """Pickler of what values contain: without what they cache, and with the code of functions and classes of one's own."""

    def reducer_override(self, value: Any) -> Any:
        parts: list[Any] | None = None
        if isinstance(value, Tensor):
            parts = [np.ascontiguousarray(value.detach().cpu().numpy())]
        elif isinstance(value, set | frozenset):
            parts = sorted(map(digest, value))
        elif isinstance(value, ModuleType):
            parts = [value.__name__]
        elif isinstance(value, type | FunctionType):
            parts = self._code(value) if _is_own(value) else None
        elif isinstance(value, CodeType):
            parts = [value.co_code, value.co_names, value.co_consts]
        elif isinstance(value, DESCRIPTORS):
            parts = [getattr(value, name, None) for name in ("fget", "fset", "func", "__func__")]
        elif callable(content_digest := getattr(value, "digest", None)):  # of spectra, which exceed the memory
            parts = [content_digest()]
        elif is_dataclass(value):
            parts = [type(value), *(getattr(value, field.name) for field in fields(value))]
        return NotImplemented if parts is None else (list, (parts,))

    def _code(self, value: Any) -> list[Any]:
        """Return what determines a function or class of one's own; its name alone inside of it."""
        known = vars(self).setdefault("known", set())
        if value in known:
            return [value.__qualname__]
        known.add(value)
        if isinstance(value, type):
            members = {
                name: x for name, x in vars(value).items() if callable(x) or not name.startswith(("__", "_abc_"))
            }
            return [value.__qualname__, *value.__mro__[1:], *sorted(members.items(), key=lambda item: item[0])]
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        named = {name: value.__globals__[name] for name in _names(value.__code__) if name in value.__globals__}
        return [value.__code__, value.__defaults__, value.__kwdefaults__, cells, named]


def _names(code: CodeType) -> list[str]:
    """Return the names in a code and in the functions inside it."""
    inside = [part for part in code.co_consts if isinstance(part, CodeType)]
    return sorted({*code.co_names}.union(*map(_names, inside)))


def _is_own(code: Any) -> bool:
    """Return True for a function or class of a notebook or a module of the user, which changes without a version."""
    name = str(code.__module__)
    file = "" if name == "__main__" else getattr(sys.modules.get(name), "__file__", None) or ""
    return name.partition(".")[0] not in OF_VERSIONS and "site-packages" not in file
