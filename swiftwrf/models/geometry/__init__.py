"""The room in which spectra were measured: mirror planes estimated from the spectra, and models built on them."""

from swiftwrf.models.geometry.fit import GeometryConfig
from swiftwrf.models.geometry.furniture import Furniture
from swiftwrf.models.geometry.hybrid import HybridModel
from swiftwrf.models.geometry.model import GeometryModel
from swiftwrf.models.geometry.planes import Plane

__all__ = ["Furniture", "GeometryConfig", "GeometryModel", "HybridModel", "Plane"]
