"""Packages whose members are imported at first use, so that importing the package loads neither torch nor SciPy.

The names are those of the import statements in the package's block `if TYPE_CHECKING`, which type checkers and editors read.
"""

from __future__ import annotations

import ast
import inspect
import sys
from pkgutil import resolve_name
from types import ModuleType
from typing import Any


class _LazyPackage(ModuleType):
    """A package that imports its members at first use (PEP 562)."""

    lazy: dict[str, str]  # module by name of the member

    def __getattr__(self, name: str) -> Any:
        if name not in self.lazy:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        value = resolve_name(f"{self.lazy[name]}.{name}")
        self.__dict__[name] = value
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        # the import system binds submodules; one with the name of a member must not hide it
        if not (isinstance(value, ModuleType) and name in self.lazy):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*self.__dict__, *self.lazy})


def import_lazily(package: str) -> None:
    """Postpone the imports in a package's block `if TYPE_CHECKING` until a name is read from it.

    `__all__` are the names that are no submodules.

    Args:
        package: `__name__` of the package.
    """
    module = sys.modules[package]
    block = next(part for part in ast.parse(inspect.getsource(module)).body if isinstance(part, ast.If))
    imports = [part for part in block.body if isinstance(part, ast.ImportFrom)]
    lazy = {name.name: str(part.module) for part in imports for name in part.names}
    module.__dict__.update(lazy=lazy, __all__=sorted(name for name, source in lazy.items() if source != package))
    module.__class__ = _LazyPackage
