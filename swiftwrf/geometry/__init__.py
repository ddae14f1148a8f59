"""The room that the spectra show: mirror planes found from them, and what follows at any position."""

from swiftwrf.geometry.fit import GeometryConfig, fit_geometry, refit_geometry
from swiftwrf.geometry.hybrid import HybridModel, fit_hybrid, room_of
from swiftwrf.geometry.model import GeometryModel, Plane

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
