"""The registry of RSSI predictors."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, Literal

from swiftwrf.rssi import RssiPredictor
from swiftwrf.runtime.registry import Registry

Preset = Literal["quick", "paper"]
PREDICTORS: Registry[RssiPredictor] = Registry("predictor", "swiftwrf.rssi_predictors")


def make_predictor(name: str, preset: Preset = "quick", **options: Any) -> RssiPredictor:
    """Return a predictor by its name, with those of the options that it has.

    Args:
        name: Name in the registry, e.g. "knn".
        preset: "quick", or "paper" for the published configuration of a predictor that has one.
        options: Options such as seed and validation. A predictor ignores options that it does not have.

    Raises:
        InputError: An unknown name, or a value outside its range.

    Example:
        >>> make_predictor("swiftwrf", "paper", seed=3).config.paper_head
        True
    """
    predictor_type = PREDICTORS[name]
    config_type = predictor_type.config_type
    config = config_type.paper() if preset == "paper" and hasattr(config_type, "paper") else config_type()
    known = {field.name for field in fields(config_type)}
    return predictor_type(config, **{key: value for key, value in options.items() if key in known})
