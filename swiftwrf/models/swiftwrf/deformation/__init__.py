"""Deformations: how the parameters of the primitives depend on the position of the moving end (paper, section 4.2).

Each is one file of this folder, with its forward pass, prior, learning rates, choice of rank and saved state.
"""

from swiftwrf.models.swiftwrf.deformation.base import (
    COMPONENTS,
    DEFORMATIONS,
    Deformation,
    DeformationContext,
    Offsets,
)

DEFORMATIONS.discover(__name__, __path__)

__all__ = ["COMPONENTS", "DEFORMATIONS", "Deformation", "DeformationContext", "Offsets"]
