"""Names and values in JSON and YAML texts: read without running code, and refused if a name occurs twice."""

from __future__ import annotations

import json
import re
from collections import Counter
from typing import Any

import yaml


def read_json(text: str) -> Any:
    """Return the value of a JSON text.

    Raises:
        ValueError: No JSON, or a name twice in an object, of which Python would keep the last.

    Example:
        >>> read_json('{"hall": -60, "hall": -90}')
        Traceback (most recent call last):
        ValueError: it names 'hall' twice; each needs a name of its own
    """
    return json.loads(text, object_pairs_hook=_each_once)


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"it names {twice!r} twice; each needs a name of its own")
    return content


class _EachNameOnce(yaml.constructor.BaseConstructor):
    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        _each_once([(key.value, None) for key, _ in node.value if isinstance(key, yaml.ScalarNode)])
        return super().construct_mapping(node, deep)


class TextLoader(_EachNameOnce, yaml.BaseLoader):
    """Loader of YAML as texts, lists and mappings."""


class TypedLoader(_EachNameOnce, yaml.SafeLoader):
    """Loader of YAML with numbers, dates and true or false in place of texts that state them."""


# 915e6, which PyYAML takes for a text without a point and a sign
_EXPONENT = re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$")
TypedLoader.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("-+0123456789"))
