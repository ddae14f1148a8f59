"""Names of field models and RSSI predictors, and types of options. Imports no torch, so a command line answers at once.

Implementations are named as in an entry point, `module:object`, and imported at first use.
"""

from __future__ import annotations

from typing import Any, Literal

from swiftwrf.runtime.registry import Registry

Moving = Literal["transmitter", "receiver"]
NotDetected = Literal["auto", "weak", "unknown"]  # meaning of an empty cell of RSSI
CalibrationPart = Literal["phases", "orientation", "position"]
PHASES_AND_ORIENTATION: tuple[CalibrationPart, ...] = ("phases", "orientation")
CARRIERS_HZ = (1e6, 1e13)

FIELD_MODELS: Registry[Any] = Registry(
    "field model",
    "swiftwrf.models",
    {
        "coarray": "swiftwrf.models.coarray:CoarrayModel",
        "geometry": "swiftwrf.models.geometry:GeometryModel",
        "hybrid": "swiftwrf.models.geometry:HybridModel",
        "nearest": "swiftwrf.models.neighbours:NearestModel",
        "gp": "swiftwrf.models.interpolator:GPModel",
        "idw": "swiftwrf.models.neighbours:IDWModel",
        "raytrace": "swiftwrf.contrib.raytraced.model:RaytraceModel",
        "swiftwrf": "swiftwrf.models.swiftwrf:SwiftWRF",
        "swiftwrf_paper": "swiftwrf.models.swiftwrf_paper:SwiftWRFPaper",
        "dcgan": "swiftwrf.contrib.published:Dcgan",
        "nerf2": "swiftwrf.contrib.published:NeRF2",
        "vae": "swiftwrf.contrib.published:Vae",
        "wrfgs": "swiftwrf.contrib.published:WrfGs",
    },
)
RSSI_PREDICTORS: Registry[Any] = Registry(
    "predictor",
    "swiftwrf.rssi_predictors",
    {
        "swiftwrf": "swiftwrf.rssi:RssiModel",
        "mean": "swiftwrf.contrib.comparison.rssi_baselines:Mean",
        "mri_pooled": "swiftwrf.contrib.comparison.rssi_baselines:SharedPathLoss",
        "mri_receiver": "swiftwrf.contrib.comparison.rssi_baselines:ReceiverPathLoss",
        "knn": "swiftwrf.contrib.comparison.rssi_baselines:KNNPredictor",
        "mri_residual": "swiftwrf.contrib.comparison.rssi_baselines:ResidualKNNPredictor",
        "gp": "swiftwrf.contrib.comparison.rssi_baselines:GPPredictor",
        "pairs": "swiftwrf.rssi:PairModel",
        "knn_pairs": "swiftwrf.contrib.comparison.rssi_baselines:PairKNN",
        "nerf2": "swiftwrf.contrib.published:NeRF2Rssi",
    },
)
PUBLISHED = {"swiftwrf": "swiftwrf_paper"}  # field models whose published settings are those of another one
