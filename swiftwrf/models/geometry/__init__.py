"""The room in which spectra were measured: mirror planes estimated from the spectra, and models built on them."""

from swiftwrf.models.geometry.fit import GeometryConfig
from swiftwrf.models.geometry.hybrid import HybridModel, fit_hybrid
from swiftwrf.models.geometry.model import GeometryModel, fit_geometry, refit_geometry
from swiftwrf.models.geometry.planes import Plane

__all__ = ["GeometryConfig", "GeometryModel", "HybridModel", "Plane", "fit_geometry", "fit_hybrid", "refit_geometry"]
