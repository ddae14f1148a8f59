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
    from swiftwrf import datasets as datasets
    from swiftwrf import locate as locate
    from swiftwrf import metrics as metrics
    from swiftwrf import rssi as rssi
    from swiftwrf.array.angles import AngularGrid, ArrayPose
    from swiftwrf.data import Rssi, Snapshots, Spectra, load_rssi, load_snapshots, load_spectra
    from swiftwrf.data.simulated import rssi_room, simulated_room
    from swiftwrf.diagnostics.calibration import calibrate
    from swiftwrf.diagnostics.inspection import inspect
    from swiftwrf.errors import FitError, InputError
    from swiftwrf.locate import MatchedField, RssiLocator
    from swiftwrf.models.base import FieldModel, make_model
    from swiftwrf.models.coarray import CoarrayModel
    from swiftwrf.models.geometry import GeometryModel, HybridModel
    from swiftwrf.models.prediction import Prediction
    from swiftwrf.models.swiftwrf import SwiftWRF, fit
    from swiftwrf.rasterize import rasterize
    from swiftwrf.rssi import PairModel, RssiModel, fit_rssi
    from swiftwrf.runtime.checkpoint import load

import_lazily(
    __name__,
    {
        "swiftwrf": ("datasets", "locate", "metrics", "rssi"),
        "swiftwrf.array.angles": ("AngularGrid", "ArrayPose"),
        "swiftwrf.data": ("Rssi", "Snapshots", "Spectra", "load_rssi", "load_snapshots", "load_spectra"),
        "swiftwrf.data.simulated": ("rssi_room", "simulated_room"),
        "swiftwrf.diagnostics.calibration": ("calibrate",),
        "swiftwrf.diagnostics.inspection": ("inspect",),
        "swiftwrf.errors": ("FitError", "InputError"),
        "swiftwrf.locate": ("MatchedField", "RssiLocator"),
        "swiftwrf.models.base": ("FieldModel", "make_model"),
        "swiftwrf.models.coarray": ("CoarrayModel",),
        "swiftwrf.models.geometry": ("GeometryModel", "HybridModel"),
        "swiftwrf.models.prediction": ("Prediction",),
        "swiftwrf.models.swiftwrf": ("SwiftWRF", "fit"),
        "swiftwrf.rasterize": ("rasterize",),
        "swiftwrf.rssi": ("PairModel", "RssiModel", "fit_rssi"),
        "swiftwrf.runtime.checkpoint": ("load",),
    },
)

__all__ = [
    "AngularGrid",
    "ArrayPose",
    "CoarrayModel",
    "FieldModel",
    "FitError",
    "GeometryModel",
    "HybridModel",
    "InputError",
    "MatchedField",
    "PairModel",
    "Prediction",
    "Rssi",
    "RssiLocator",
    "RssiModel",
    "Snapshots",
    "Spectra",
    "SwiftWRF",
    "calibrate",
    "fit",
    "fit_rssi",
    "inspect",
    "load",
    "load_rssi",
    "load_snapshots",
    "load_spectra",
    "make_model",
    "rasterize",
    "rssi_room",
    "simulated_room",
]
