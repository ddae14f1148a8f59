"""The room that the spectra show: mirror planes found from them, and what follows at any position."""

from swiftwrf.models.geometry.fit import GeometryConfig, fit_geometry, refit_geometry
from swiftwrf.models.geometry.hybrid import HybridModel, fit_hybrid, room_of
from swiftwrf.models.geometry.model import GeometryModel, Plane

__all__ = [
    "GeometryConfig",
    "GeometryModel",
    "HybridModel",
    "Plane",
    "fit_geometry",
    "fit_hybrid",
    "refit_geometry",
    "room_of",
]
