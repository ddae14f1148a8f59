"""Names that options take: of implementations, rooms, ends of a link. Imports no torch, so a command line answers at once.

Implementations are named as in an entry point, `module:object`, and imported at first use.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from swiftwrf.errors import InputError
from swiftwrf.runtime.registry import Registry

Moving = Literal["transmitter", "receiver"]
NotDetected = Literal["auto", "weak", "unknown"]  # meaning of an empty cell of RSSI
CARRIERS_HZ = (1e6, 1e13)
MAX_SUGGESTIONS = 500  # positions to measure next
AUTO = "auto"  # the field model that cross-validation chooses
RAYTRACE = "raytrace"  # the field model that takes a scene
SCENE_FILE = ".xml"  # suffix of scene files; other names are those of rooms

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
ROOMS = {  # what stands in the rooms of data/raytraced/rooms.yml
    "conference": "conference room, 8 x 5 x 2.8 m: a table with ten chairs, screen, whiteboard, sideboard",
    "office": "office, 6 x 5 x 2.7 m: four desks with screens, a partition, metal cabinets, shelves",
    "bedroom": "bedroom, 4.2 x 3.6 x 2.5 m: a double bed, wardrobe, chest of drawers, nightstands",
}


def check_scene(name: str, prefix: str = "") -> None:
    """Refuse a name that is neither a built-in room nor a scene file; the message names it after the prefix.

    Raises:
        InputError: No such room or file.

    Example:
        >>> check_scene("office")
    """
    if not name.endswith(SCENE_FILE) and name not in ROOMS:
        raise InputError(f"unknown room {name!r}; choose from {', '.join(ROOMS)}")
    if name.endswith(SCENE_FILE) and not Path(name).is_file():
        raise InputError(f"{prefix}{name} does not exist; expected a Mitsuba scene, or one of {', '.join(ROOMS)}")


def fraction_key(fraction: float) -> str:
    """Return the shortest text that reads back as the same number, for keys and file names.

    Example:
        >>> fraction_key(0.3), fraction_key(1.0), fraction_key(0.6666667)
        ('0.3', '1', '0.6666667')
    """
    short = f"{fraction:g}"
    return short if float(short) == fraction else repr(fraction)
