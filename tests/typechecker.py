"""Checks annotations while testing, as type checkers read them: an int will do where a float is expected (PEP 484)."""

from collections.abc import Callable
from typing import TypeVar

from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintPep673Exception

Function = TypeVar("Function", bound=Callable)
_check = beartype(conf=BeartypeConf(is_pep484_tower=True))


def check(function: Function) -> Function:
    """Return the function with its annotations checked; beartype knows `Self` only where it decorates the whole class."""
    try:
        return _check(function)
    except BeartypeDecorHintPep673Exception:
        return function
