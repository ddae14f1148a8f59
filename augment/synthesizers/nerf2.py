"""NeRF2; see `swiftwrf.comparison.nerf2`."""

from __future__ import annotations

from augment.synthesizers.base import FIXED_END, SYNTHESIZERS
from augment.synthesizers.published import Published
from swiftwrf.comparison import NeRF2Config


@SYNTHESIZERS.register(
    "nerf2",
    meaning="a neural field summed along rays (NeRF2)",
    needs=(FIXED_END,),
    colour="#44aa99",
)
class NeRF2Synthesizer(Published):
    """A network that says how space absorbs, turns and emits."""

    config = NeRF2Config
