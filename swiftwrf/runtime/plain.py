"""Names and values in JSON and YAML texts: read without running code, and refused if a name occurs twice."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import yaml


def read_json(text: str) -> Any:
    """Return the value of a JSON text, in which each name of an object occurs once.

    Raises:
        ValueError: No JSON, or a name twice, of which Python would keep the last.

    Example:
        >>> read_json('{"hall": -60.5}')
        {'hall': -60.5}
        >>> read_json('{"hall": -60.5, "hall": -90}')
        Traceback (most recent call last):
        ValueError: it names 'hall' twice; each needs a name of its own
    """

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        refuse_repeated(name for name, _ in pairs)
        return dict(pairs)

    return json.loads(text, object_pairs_hook=once)


def refuse_repeated(names: Iterable[str]) -> None:
    """Raise ValueError if a name occurs twice."""
    seen = set[str]()
    for name in names:
        if name in seen:
            raise ValueError(f"it names {name!r} twice; each needs a name of its own")
        seen.add(name)


class _EachNameOnce(yaml.constructor.BaseConstructor):
    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        refuse_repeated(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        return super().construct_mapping(node, deep)


class TextLoader(_EachNameOnce, yaml.BaseLoader):
    """Loader of YAML as texts, lists and mappings."""


class TypedLoader(_EachNameOnce, yaml.SafeLoader):
    """Loader of YAML with numbers, dates and true or false in place of texts that state them."""
