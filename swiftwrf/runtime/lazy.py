"""Packages whose members are imported at first use, so that importing the package loads neither torch nor SciPy.

The `__init__` of such a package holds usual import statements, which type checkers and editors read as they stand:

    with lazy_imports(globals()):
        from swiftwrf.models import SwiftWRF

The statement binds nothing. The module is imported when `SwiftWRF` is first read from the package (PEP 562).
"""

from __future__ import annotations

import builtins
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType
from typing import Any


class _Name:
    """Stands for every member of a module whose import is postponed."""

    def __getattr__(self, name: str) -> None:
        return None


class _LazyPackage(ModuleType):
    """A package that imports its members at first use."""

    lazy: dict[str, str]  # module by name of the member

    def __getattr__(self, name: str) -> Any:
        if name not in self.lazy:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        module = self.lazy[name]
        value = import_module(f"{module}.{name}") if module == self.__name__ else getattr(import_module(module), name)
        self.__dict__[name] = value
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        # the import system binds submodules; one with the name of a member must not hide it
        if not (isinstance(value, ModuleType) and name in self.lazy):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*self.__dict__, *self.lazy})


@contextmanager
def lazy_imports(namespace: dict[str, Any]) -> Iterator[None]:
    """Postpone the statements `from MODULE import NAME, ...` in the block until a name is used.

    Args:
        namespace: `globals()` of the `__init__` of a package.
    """
    package = sys.modules[namespace["__name__"]]
    eager, members = builtins.__import__, {}

    def postpone(
        module: str,
        globals: Mapping[str, Any] | None = None,
        locals: Mapping[str, Any] | None = None,
        names: Sequence[str] | None = (),
        level: int = 0,
    ) -> Any:
        if globals is not namespace:  # another thread imports
            return eager(module, globals, locals, names or (), level)
        members.update(dict.fromkeys(names or (), module))
        return _Name()

    builtins.__import__ = postpone  # type: ignore[assignment]  # returns what stands for a module
    try:
        yield
    finally:
        builtins.__import__ = eager
    for name in members:
        del namespace[name]
    package.__dict__["lazy"] = members
    package.__class__ = _LazyPackage
