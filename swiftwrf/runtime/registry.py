"""One registry for each kind of thing that comes in several makes: synthesizers, predictors, deformations, formats, ...

Help texts, reports, colours and benchmarks read the registry; adding a make is one new file in the folder of its kind.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from swiftwrf.errors import InputError

Made = TypeVar("Made")
Factory = TypeVar("Factory", bound=Callable[..., object])


@dataclass(frozen=True)
class Entry(Generic[Made]):
    """One make of a kind.

    Args:
        name: what users call it.
        make: builds one.
        meaning: in one line.
        needs: what the data must tell for it, in words (`array`, `positions of the receivers`).
        colour: in figures, `#rrggbb`; None leaves the choice to the figure.
    """

    name: str
    make: Callable[..., Made]
    meaning: str
    needs: tuple[str, ...] = ()
    colour: str | None = None


class Registry(Generic[Made]):
    """The makes of one kind by name, in the order of their registration.

    Args:
        kind: what they are, for messages.
    """

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._entries: dict[str, Entry[Made]] = {}

    def register(
        self, name: str, *, meaning: str, needs: tuple[str, ...] = (), colour: str | None = None
    ) -> Callable[[Factory], Factory]:
        """Decorator of a class or function that builds what `name` stands for.

        Raises:
            ValueError: the name is taken.
        """

        def decorate(factory: Factory) -> Factory:
            if name in self._entries:
                raise ValueError(f"{self.kind} {name!r} is registered already")
            self._entries[name] = Entry(name, factory, meaning, needs, colour)  # type: ignore[arg-type]
            return factory

        return decorate

    def discover(self, package: str, path: list[str], first: tuple[str, ...] = ()) -> None:
        """Imports every module of a package, those named `first` before the others, so that each registers what it holds."""
        for module in (*first, *sorted(module.name for module in pkgutil.iter_modules(path))):
            importlib.import_module(f"{package}.{module}")

    def __getitem__(self, name: str) -> Entry[Made]:
        """The entry of that name.

        Raises:
            InputError: there is none.
        """
        if name not in self._entries:
            raise InputError(f"unknown {self.kind} {name!r}; choose from {', '.join(self)}")
        return self._entries[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __len__(self) -> int:
        return len(self._entries)

    def entries(self) -> list[Entry[Made]]:
        """All of them, in order."""
        return list(self._entries.values())
