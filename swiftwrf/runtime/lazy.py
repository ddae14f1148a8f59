"""Packages whose members are imported at first use, so that importing the package loads neither torch nor SciPy.

Type checkers and editors read the usual import statements, in a block `if TYPE_CHECKING`, as `import name as name`.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from types import ModuleType
from typing import Any


class _LazyPackage(ModuleType):
    """A package that imports its members at first use (PEP 562)."""

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


def import_lazily(package: str, members: Mapping[str, Sequence[str]]) -> None:
    """Postpone the imports of a package until a name is read from it. `__all__` are the names that are no submodules.

    Args:
        package: `__name__` of the package.
        members: Names by the module that defines them; submodules by the package.
    """
    module = sys.modules[package]
    lazy = {name: source for source, names in members.items() for name in names}
    module.__dict__.update(lazy=lazy, __all__=sorted(name for name, source in lazy.items() if source != package))
    module.__class__ = _LazyPackage
