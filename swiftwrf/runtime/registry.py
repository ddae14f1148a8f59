"""Registries of implementations by name: field models, estimators, readers, beamformers.

An implementation registers itself when its module is imported, or is declared as `module:object` and imported at first use.
Other packages declare implementations by entry points of the registry's group. Names are known without any import.
"""

from __future__ import annotations

import inspect
import pkgutil
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import Any, TypeVar

from swiftwrf.errors import InputError

Made = TypeVar("Made")
Registered = TypeVar("Registered", bound=Callable[..., Any])


class Registry(Mapping[str, type[Made]]):
    """Implementations of one kind by name, in the order of their registration.

    Args:
        kind: Kind of the implementations, for messages.
        group: Group of entry points by which other packages add implementations. None for a closed registry.
        declared: References `module:object` to implementations of this package by name.

    Example:
        >>> shapes: Registry[object] = Registry("shape")
        >>> @shapes.register("circle")
        ... class Circle:
        ...     '''A round shape.'''
        >>> shapes["circle"].__name__, shapes.summary("circle")
        ('Circle', 'A round shape')
    """

    def __init__(self, kind: str, group: str | None = None, declared: Mapping[str, str] = MappingProxyType({})) -> None:
        self.kind, self.group = kind, group
        self._registered: dict[str, Any] = dict(declared)  # implementations, and references before their first use

    def register(self, name: str) -> Callable[[Registered], Registered]:
        """Return a decorator that registers a class or function under a name.

        Raises:
            ValueError: The name is taken.
        """

        def decorate(implementation: Registered) -> Registered:
            if self._registered.setdefault(name, implementation) is not implementation:
                raise ValueError(f"{self.kind} {name!r} is registered already")
            return implementation

        return decorate

    def check(self, name: str) -> None:
        """Refuse an unknown name.

        Raises:
            InputError: There is no implementation of that name.
        """
        if name not in self:
            raise InputError(f"unknown {self.kind} {name!r}; choose from {', '.join(self)}")

    def summary(self, name: str) -> str:
        """Return the first line of an implementation's docstring, without its full stop."""
        return (inspect.getdoc(self[name]) or "").partition("\n")[0].removesuffix(".")

    def _external(self) -> dict[str, Any]:
        points = _entry_points(self.group, tuple(sys.path)) if self.group else ()
        return {point.name: point for point in points if point.name not in self._registered}

    def __getitem__(self, name: str) -> Any:
        """Return the implementation of that name.

        Raises:
            InputError: There is none, or the package that provides it cannot be imported.
        """
        self.check(name)
        implementation = self._registered.get(name)
        if isinstance(implementation, str):
            implementation = self._registered[name] = pkgutil.resolve_name(implementation)
        if implementation is not None:
            return implementation
        point = self._external()[name]
        try:
            implementation = point.load()
        except Exception as error:  # code of another package may raise anything
            raise InputError(f"{self.kind} {name!r} of {point.value} cannot be imported ({error})") from error
        return self._registered.setdefault(name, implementation)

    def __iter__(self) -> Iterator[str]:
        return iter((*self._registered, *self._external()))

    def __contains__(self, name: object) -> bool:
        return name in self._registered or name in self._external()

    def __len__(self) -> int:
        return len(tuple(iter(self)))


@lru_cache(maxsize=32)
def _entry_points(group: str, path: tuple[str, ...]) -> tuple[Any, ...]:
    """Return the entry points of a group. A search reads the metadata of every installed package, so its result is kept."""
    # a backport of importlib.metadata, if another package has loaded it, returns its own class
    return tuple(entry_points(group=group))
