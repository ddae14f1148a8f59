"""The RSSI predictors that a comparison fits, by name or as objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.data import Rssi
from swiftwrf.errors import InputError
from swiftwrf.rssi.base import RssiPredictor
from swiftwrf.rssi.model import RssiModel
from swiftwrf.rssi.pairs import PairModel
from swiftwrf.rssi.paper import RssiPaperModel
from swiftwrf.runtime.validation import Preset, checked

ALWAYS = (RssiModel.name, PairModel.name, "mean")  # compared whatever is named


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
    predictor_type: type[RssiPredictor] = RssiPaperModel if is_published else RSSI_PREDICTORS[name]
    return predictor_type(**predictor_type.supported({"preset": preset} | options))


def compared(
    data: Rssi, also: Sequence[str | RssiPredictor] = (), only: Sequence[str] = ()
) -> tuple[list[str], dict[str, str]]:
    """Return the names of the predictors that are compared on these data, and the reason for each one that is left out.

    Args:
        data: RSSI.
        also: Names of predictors that are compared only when named, and predictors of your own with other names.
        only: Predictors beside the model of this package and the mean, in place of all that suit the data.

    Raises:
        InputError: An unknown name, or a predictor of your own with a known one.

    Example:
        >>> import swiftwrf
        >>> compared(swiftwrf.rssi_room(n=20))[0]
        ['swiftwrf', 'mean', 'mri_pooled', 'mri_receiver', 'knn', 'mri_residual', 'gp']
        >>> compared(swiftwrf.rssi_room(n=20), only=["knn"])[0]
        ['swiftwrf', 'mean', 'knn']
    """
    own = [predictor for predictor in also if isinstance(predictor, RssiPredictor)]
    for name in (*also, *only):
        if isinstance(name, str):
            RSSI_PREDICTORS.check(name)
    types = {name: RSSI_PREDICTORS[name] for name in RSSI_PREDICTORS}
    types = {name: one for name, one in types.items() if one.compared(data) or name in (*also, *only)}
    if only:
        types = {name: one for name, one in types.items() if name in (*ALWAYS, *also, *only)}
    for predictor in own:
        if predictor.name in RSSI_PREDICTORS or predictor.name in types:
            raise InputError(
                f"also has a predictor {predictor.name!r}, which is the name of another one; give it its own"
            )
        types[predictor.name] = type(predictor)
    left_out = {name: reason for name, one in types.items() if (reason := one.lacking(data))}
    return [name for name in types if name not in left_out], left_out
