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
    from swiftwrf.array.angles import AngularGrid as AngularGrid
    from swiftwrf.array.angles import ArrayPose as ArrayPose
    from swiftwrf.contrib.diagnostics.calibration import calibrate as calibrate
    from swiftwrf.contrib.diagnostics.inspection import inspect as inspect
    from swiftwrf.data import Rssi as Rssi
    from swiftwrf.data import Snapshots as Snapshots
    from swiftwrf.data import Spectra as Spectra
    from swiftwrf.data import Stations as Stations
    from swiftwrf.data import load_rssi as load_rssi
    from swiftwrf.data import load_snapshots as load_snapshots
    from swiftwrf.data import load_spectra as load_spectra
    from swiftwrf.data import load_stations as load_stations
    from swiftwrf.data.simulated import rssi_room as rssi_room
    from swiftwrf.data.simulated import simulated_room as simulated_room
    from swiftwrf.data.simulated import simulated_stations as simulated_stations
    from swiftwrf.errors import FitError as FitError
    from swiftwrf.errors import InputError as InputError
    from swiftwrf.locate import MatchedField as MatchedField
    from swiftwrf.locate import RssiLocator as RssiLocator
    from swiftwrf.models.base import FieldModel as FieldModel
    from swiftwrf.models.base import make_model as make_model
    from swiftwrf.models.geometry import GeometryModel as GeometryModel
    from swiftwrf.models.prediction import Prediction as Prediction
    from swiftwrf.models.swiftwrf import SwiftWRF as SwiftWRF
    from swiftwrf.models.swiftwrf import fit as fit
    from swiftwrf.predicting import predict as predict
    from swiftwrf.rasterize import rasterize as rasterize
    from swiftwrf.rssi import PairModel as PairModel
    from swiftwrf.rssi import RssiModel as RssiModel
    from swiftwrf.rssi import fit_rssi as fit_rssi
    from swiftwrf.runtime.checkpoint import load as load

import_lazily(__name__)
