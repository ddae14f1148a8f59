"""Models with declared options: one constructor for all of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import fields, is_dataclass, replace
from functools import wraps
from typing import Any, ClassVar, Literal, TypeVar, cast, get_type_hints

from swiftwrf.errors import InputError
from swiftwrf.runtime.validation import checked

Preset = Literal["quick", "paper"]
Fit = TypeVar("Fit", bound=Callable[..., Any])


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
        return hasattr(self, self.fitted_attribute)

    def check_fitted(self) -> None:
        """Raise InputError if the model is not fitted."""
        if not self.is_fitted:
            raise InputError(f"this {type(self).__name__} is not fitted; call fit first")

    @classmethod
    def supported(cls, options: Mapping[str, Any]) -> dict[str, Any]:
        """Return those of the options, `preset` among them, that the constructor takes."""
        known = {field.name for field in fields(cls.config_type)}
        preset = options.get("preset") == "quick" or hasattr(cls.config_type, "paper")
        return {name: value for name, value in options.items() if name in known or (name == "preset" and preset)}


def all_or_nothing(fit: Fit) -> Fit:
    """Return a method `fit` that fits a copy, whose state the object takes over when the fit has succeeded."""

    @wraps(fit)
    def fit_copy(self: Any, *arguments: Any, **options: Any) -> Any:
        vars(self).update(vars(fit(copy(self), *arguments, **options)))
        return self

    return cast(Fit, fit_copy)


def from_plain(config_type: type[Any], options: Mapping[str, Any]) -> Any:
    """Return a configuration from values that JSON has stored: nested configurations as objects, tuples as lists."""
    hints = get_type_hints(config_type)

    def restored(name: str, value: Any) -> Any:
        if is_dataclass(hints.get(name)):
            return from_plain(hints[name], value)
        return tuple(value) if isinstance(value, list) else value

    return config_type(**{name: restored(name, value) for name, value in options.items()})
