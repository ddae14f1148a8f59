"""Predict spatial spectra and RSSI at positions without measurements.

data = swiftwrf.load_spectra(folder)
train, test = data.split("block")
model = swiftwrf.SwiftWRF().fit(train)
spectrum = model.predict(test.position).mean

"The paper" in all docstrings is M. Liu, C. Zhang, Q. Yang, Y. Cao, Y. Xu, Y. Xu, S. Sun, M. Dai and Y. Guan, "Deformable 2D
Gaussian Splatting for Efficient Wireless Radiance Field Rendering", 2025.
"""

from importlib.metadata import version
from typing import TYPE_CHECKING

from swiftwrf.runtime.lazy import import_lazily

__version__ = version("swiftwrf-tasks")

if TYPE_CHECKING:
    from swiftwrf import comparison, datasets
    from swiftwrf.array.angles import AngularGrid, ArrayPose
    from swiftwrf.choices import FIELD_MODELS
    from swiftwrf.data import Rssi, Snapshots, Spectra, load_rssi, load_snapshots, load_spectra
    from swiftwrf.data.simulated import rssi_room, simulated_room
    from swiftwrf.diagnostics.calibration import Calibration, calibrate
    from swiftwrf.errors import FitError, InputError
    from swiftwrf.locate import MatchedField, Posterior, RssiLocator
    from swiftwrf.models.base import FieldModel, make_model
    from swiftwrf.models.coarray import CoarrayModel
    from swiftwrf.models.geometry import GeometryModel, HybridModel, fit_geometry, fit_hybrid
    from swiftwrf.models.prediction import Prediction
    from swiftwrf.models.swiftwrf import SwiftWRF, fit
    from swiftwrf.models.swiftwrf_paper import SwiftWRFPaper
    from swiftwrf.rasterize import rasterize, rasterize_magnitude
    from swiftwrf.rssi import PairModel, RssiConfig, RssiModel, fit_rssi
    from swiftwrf.runtime.checkpoint import load

import_lazily(
    __name__,
    {
        "swiftwrf": ("comparison", "datasets"),
        "swiftwrf.array.angles": ("AngularGrid", "ArrayPose"),
        "swiftwrf.choices": ("FIELD_MODELS",),
        "swiftwrf.data": ("Rssi", "Snapshots", "Spectra", "load_rssi", "load_snapshots", "load_spectra"),
        "swiftwrf.data.simulated": ("rssi_room", "simulated_room"),
        "swiftwrf.diagnostics.calibration": ("Calibration", "calibrate"),
        "swiftwrf.errors": ("FitError", "InputError"),
        "swiftwrf.locate": ("MatchedField", "Posterior", "RssiLocator"),
        "swiftwrf.models.base": ("FieldModel", "make_model"),
        "swiftwrf.models.coarray": ("CoarrayModel",),
        "swiftwrf.models.geometry": ("GeometryModel", "HybridModel", "fit_geometry", "fit_hybrid"),
        "swiftwrf.models.prediction": ("Prediction",),
        "swiftwrf.models.swiftwrf": ("SwiftWRF", "fit"),
        "swiftwrf.models.swiftwrf_paper": ("SwiftWRFPaper",),
        "swiftwrf.rasterize": ("rasterize", "rasterize_magnitude"),
        "swiftwrf.rssi": ("PairModel", "RssiConfig", "RssiModel", "fit_rssi"),
        "swiftwrf.runtime.checkpoint": ("load",),
    },
)

__all__ = [
    "FIELD_MODELS",
    "AngularGrid",
    "ArrayPose",
    "Calibration",
    "CoarrayModel",
    "FieldModel",
    "FitError",
    "GeometryModel",
    "HybridModel",
    "InputError",
    "MatchedField",
    "PairModel",
    "Posterior",
    "Prediction",
    "Rssi",
    "RssiConfig",
    "RssiLocator",
    "RssiModel",
    "Snapshots",
    "Spectra",
    "SwiftWRF",
    "SwiftWRFPaper",
    "calibrate",
    "comparison",
    "datasets",
    "fit",
    "fit_geometry",
    "fit_hybrid",
    "fit_rssi",
    "load",
    "load_rssi",
    "load_snapshots",
    "load_spectra",
    "make_model",
    "rasterize",
    "rasterize_magnitude",
    "rssi_room",
    "simulated_room",
]
