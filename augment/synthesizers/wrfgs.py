"""WRF-GS; see `swiftwrf.comparison.wrfgs`."""

from __future__ import annotations

from augment.synthesizers.base import FIXED_END, SYNTHESIZERS
from augment.synthesizers.published import Published
from swiftwrf.comparison import WrfGsConfig


@SYNTHESIZERS.register(
    "wrfgs",
    meaning="3D Gaussians drawn on the array's sphere (WRF-GS)",
    needs=(FIXED_END,),
    colour="#882255",
)
class WrfGsSynthesizer(Published):
    """3D Gaussians that stay where they are, with signals from a network."""

    config = WrfGsConfig
