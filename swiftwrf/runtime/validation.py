"""Declared ranges: annotations of configurations, arguments and models' options, checked when a value is given.

`Literal` lists the allowed values, `Annotated[int, Ge(1)]` gives a range (package annotated-types). Type checkers read the
same annotations; this module enforces them at run time, where a user's value arrives.
"""

from __future__ import annotations

import functools
import inspect
import math
import operator
import sys
import types
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, fields, replace
from numbers import Integral, Real
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from annotated_types import Ge, Gt, Le, Lt

from swiftwrf.errors import InputError, NotFitted

NonNegativeInt = Annotated[int, Ge(0)]
PositiveInt = Annotated[int, Ge(1)]
NonNegativeFloat = Annotated[float, Ge(0)]
PositiveFloat = Annotated[float, Gt(0)]
Fraction = Annotated[float, Ge(0), Le(1)]
Preset = Literal["quick", "paper"]

Function = TypeVar("Function", bound=Callable[..., Any])
Class = TypeVar("Class")
NUMBERS = {int: Integral, float: Real}  # NumPy's scalars among them
LARGEST = {int: 2**63 - 1, float: sys.float_info.max}  # whole number that is accepted
RANGES: dict[type, tuple[str, str, Callable[[Any, Any], bool]]] = {  # in words, attribute of the bound, comparison
    Ge: ("at least", "ge", operator.ge),
    Gt: ("above", "gt", operator.gt),
    Le: ("at most", "le", operator.le),
    Lt: ("below", "lt", operator.lt),
}


def check_value(name: str, value: object, annotation: Any) -> None:
    """Refuse a value that its annotation does not allow.

    Understands `Literal`, `Annotated` with ranges, unions, tuples, lists, mappings and classes; other annotations pass.

    Args:
        name: Name of the value, for the message.
        value: Value to check.
        annotation: Resolved type annotation.

    Raises:
        InputError: The value is not allowed.

    Example:
        >>> check_value("end", "receiver", Literal["transmitter", "receiver"])
    """
    if not _allowed(value, annotation):
        raise InputError(f"{name} must be {_described(annotation)}, got {value!r}")


def _allowed(value: object, annotation: Any) -> bool:
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        bounds = [(*RANGES[type(bound)][1:], bound) for bound in arguments[1:] if type(bound) in RANGES]
        return _allowed(value, arguments[0]) and all(holds(value, getattr(b, name)) for name, holds, b in bounds)
    if origin is Literal:
        return any(type(value) is type(item) and value == item for item in arguments)
    if origin in (Union, types.UnionType):
        return any(_allowed(value, item) for item in arguments)
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        if arguments[-1] is ...:
            return all(_allowed(item, arguments[0]) for item in value)
        return len(value) == len(arguments) and all(map(_allowed, value, arguments))
    if origin in (list, Sequence):
        try:
            items: Any = (
                value.tolist() if origin is Sequence and hasattr(value, "tolist") else value
            )  # an array or a column
        except RuntimeError:  # a tensor without values
            return False
        is_listed = isinstance(items, origin) and not isinstance(items, str | bytes)
        return is_listed and all(_allowed(item, arguments[0]) for item in items)
    if origin is Mapping:
        return isinstance(value, Mapping) and all(all(map(_allowed, item, arguments)) for item in value.items())
    if annotation in NUMBERS:
        is_number = isinstance(value, NUMBERS[annotation]) and not isinstance(value, bool)
        if isinstance(value, Integral):
            return is_number and abs(int(value)) <= LARGEST[annotation]
        return is_number and not math.isnan(value)  # type: ignore[arg-type]
    if annotation in (None, type(None)):
        return value is None
    return annotation is Any or not isinstance(annotation, type) or isinstance(value, annotation)


def _described(annotation: Any) -> str:
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        bounds = [f"{RANGES[type(b)][0]} {getattr(b, RANGES[type(b)][1])}" for b in arguments[1:] if type(b) in RANGES]
        return " ".join([_described(arguments[0]), *bounds[:1], *(f"and {bound}" for bound in bounds[1:])])
    if origin is Literal:
        return " or ".join(map(repr, arguments))
    if origin in (Union, types.UnionType):
        return " or ".join(map(_described, arguments))
    if origin is tuple:
        return (
            f"a tuple of {_described(arguments[0])}" if arguments[-1] is ... else f"a tuple of {len(arguments)} values"
        )
    if origin is Mapping:
        return f"a dictionary, of which each key is {_described(arguments[0])} with {_described(arguments[1])}"
    if origin in (list, Sequence):
        return f"a list, of which each is {_described(arguments[0])}"
    names = {int: "a whole number", float: "a number", bool: "True or False", str: "a text", type(None): "None"}
    is_class = isinstance(annotation, type) and annotation not in names
    return f"an instance of {annotation.__name__}" if is_class else names.get(annotation, str(annotation))


@dataclass_transform(frozen_default=True)
def configuration(cls: type[Class]) -> type[Class]:
    """Make a class a frozen dataclass whose fields are checked against their annotations.

    A `check(self)` method, if the class defines one, runs afterwards for conditions between fields.

    Raises:
        InputError: At construction, for the first field with a value that its annotation does not allow.

    Example:
        >>> @configuration
        ... class Search:
        ...     width: PositiveInt = 8
        >>> Search(width=4)
        Search(width=4)
    """

    def check_fields(self: Any) -> None:
        hints = hints_of(cls)  # type: ignore[arg-type]
        for field in fields(self):
            value = getattr(self, field.name)
            check_value(field.name, value, hints[field.name])
            if isinstance(value, Real) and hasattr(value, "item"):  # NumPy's scalars, which JSON does not store
                object.__setattr__(self, field.name, value.item())
        if hasattr(self, "check"):
            self.check()

    cls.__post_init__ = check_fields  # type: ignore[attr-defined]
    made = dataclass(frozen=True)(cls)
    made.__init__.__no_type_check__ = True  # type: ignore[attr-defined]  # the check above has the better message
    return made


@functools.cache
def hints_of(annotated: Any) -> dict[str, Any]:
    """Return the annotations of a class or function, resolved and with their ranges."""
    return get_type_hints(annotated, include_extras=True)


def checked(function: Function) -> Function:
    """Check the arguments of a function against their annotations.

    Raises:
        InputError: At a call, for the first argument with a value that its annotation does not allow, and for an argument
            that the function does not take.

    Example:
        >>> @checked
        ... def room(n: PositiveInt = 1) -> int:
        ...     return n
        >>> room(3)
        3
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def wrapped(*arguments: Any, **options: Any) -> Any:
        hints = hints_of(function)
        try:
            bound = signature.bind(*arguments, **options)
        except TypeError as error:
            taken = ", ".join(name for name in signature.parameters if name != "self")
            raise InputError(f"{function.__name__}() {error}; it takes {taken}") from None
        for name, value in bound.arguments.items():
            if name in hints:
                check_value(name, value, hints[name])
        return function(*arguments, **options)

    return wrapped  # type: ignore[return-value]


class Configured:
    """Base class of models whose options are keyword arguments of the constructor; `config_type` declares their ranges.

    Args:
        config: Options as one object. Defaults to those of the preset.
        preset: "quick" for the defaults, sized for a desktop; "paper" for the settings of the model's publication.
        options: Single options, which replace those of `config`.

    Raises:
        InputError: An unknown option, a preset that the model does not have, or a value outside its range.
    """

    config_type: ClassVar[type[Any]]
    """dataclass of the options"""
    fitted_attribute: ClassVar[str]
    """name of an attribute that only a fitted model has"""

    @checked
    def __init__(self, config: Any = None, *, preset: Preset = "quick", **options: Any) -> None:
        known = [field.name for field in fields(self.config_type)]
        unknown = [name for name in options if name not in known]
        if unknown:
            raise InputError(f"{type(self).__name__} has no option {unknown[0]!r}; it has {', '.join(known)}")
        if config is None:
            if not self.supported({"preset": preset}):
                raise InputError(
                    f"{type(self).__name__} has no published settings; leave preset='paper' out, or let "
                    "make_model(name, preset='paper') return the published model"
                )
            self.config = (self.config_type.paper if preset == "paper" else self.config_type)(**options)
        elif isinstance(config, self.config_type):
            self.config = replace(config, **options)
        else:
            raise InputError(f"{type(self).__name__} takes a {self.config_type.__name__}, got {type(config).__name__}")

    @property
    def is_fitted(self) -> bool:
        """True after `fit`, and for a model that was loaded."""
        return self.fitted_attribute in vars(self)

    def check_fitted(self) -> None:
        """Refuse a model that is not fitted.

        Raises:
            NotFitted: It is not.
        """
        if not self.is_fitted:
            raise NotFitted(f"this {type(self).__name__} is not fitted; call fit first")

    if not TYPE_CHECKING:  # for which any name would be an attribute

        def __getattr__(self, name: str) -> Any:
            """Refuse an attribute that the class declares and `fit` sets."""
            declared = (vars(kind) | getattr(kind, "__annotations__", {}) for kind in type(self).__mro__)
            if any(name in names for names in declared):
                self.check_fitted()
            return self.__getattribute__(name)  # raises the usual error

    @classmethod
    def supported(cls, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return those of the options, `preset` among them, that the constructor takes."""
        known = {field.name for field in fields(cls.config_type)}
        preset = options.get("preset") == "quick" or hasattr(cls.config_type, "paper")
        return {name: value for name, value in options.items() if name in known or (name == "preset" and preset)}


def all_or_nothing(fit: Function) -> Function:
    """Return a method `fit` that fits a copy, whose state the object takes over when the fit has succeeded."""

    @functools.wraps(fit)
    def fit_copy(self: Any, *arguments: Any, **options: Any) -> Any:
        vars(self).update(vars(fit(copy(self), *arguments, **options)))
        return self

    return fit_copy  # type: ignore[return-value]
