"""Construction of RSSI predictors by name."""

from __future__ import annotations

from typing import Any

from swiftwrf.rssi import RssiModel, RssiPaperModel, RssiPredictor
from swiftwrf.runtime.validation import Preset, checked
from tasks.rssi.predictors import PREDICTORS


@checked
def make_predictor(name: str, preset: Preset = "quick", **options: Any) -> RssiPredictor:
    """Return a predictor by its name, with those of the options that it has.

    Args:
        name: Name in the registry, e.g. "knn".
        preset: "quick", or "paper" for published settings; a predictor without published settings ignores it. With "paper"
            the name "swiftwrf" gives `RssiPaperModel`.
        options: Options such as seed and validation. A predictor ignores options that it does not have.

    Raises:
        InputError: An unknown name, or a value outside its range.

    Example:
        >>> make_predictor("swiftwrf", "paper", seed=3).name
        'swiftwrf_paper'
    """
    is_published = name == RssiModel.name and preset == "paper"
    predictor_type: type[RssiPredictor] = RssiPaperModel if is_published else PREDICTORS[name]
    return predictor_type(**predictor_type.supported({"preset": preset} | options))
