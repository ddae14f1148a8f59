"""The room that the spectra show: mirror planes found from them, and what follows at any position."""

from swiftwrf.geometry.fit import GeometryConfig, fit_geometry
from swiftwrf.geometry.model import GeometryModel, Plane

__all__ = ["GeometryConfig", "GeometryModel", "Plane", "fit_geometry"]
