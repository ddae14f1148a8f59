"""Deformations: how the primitives move, answer and fade as one end of the link moves (paper, section 4.2).

Each is one file of this folder. It owns its forward pass, prior, learning rates, choice of what the configuration leaves
open, and saved state.
"""

from swiftwrf.models.swiftwrf.deformation.base import (
    COMPONENTS,
    DEFORMATIONS,
    Deformation,
    Offsets,
    Setting,
    deformation_type,
)

DEFORMATIONS.discover(__name__, __path__)

__all__ = ["COMPONENTS", "DEFORMATIONS", "Deformation", "Offsets", "Setting", "deformation_type"]
