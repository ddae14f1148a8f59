"""Files of measurements, predictions and maps, written by their suffix."""

from __future__ import annotations

from os.path import isfile  # unlike Path.is_file, it is False for names that are too long
from pathlib import Path

import numpy as np

from swiftwrf import FieldModel, InputError, RssiModel, load
from swiftwrf.data.dataset import Labelled
from swiftwrf.data.rasters import Cells, write_geojson, write_geotiff, write_world_file
from swiftwrf.data.writing import write_mat
from swiftwrf.errors import with_article
from swiftwrf.locate import RssiLocator
from swiftwrf.rssi.base import RssiPredictor
from swiftwrf.rssi.maps import RssiMap
from swiftwrf.runtime.checkpoint import Saved
from swiftwrf.runtime.durable import replacing
from tasks.claim import CONFIG, model_file
from tasks.convert.options import MAPS, ConvertConfig
from tasks.environment import command
from tasks.page.maps import colour_image
from tasks.records import rounded, write_table

WORLD_FILE = ".pgw"  # suffix beside a .png


def saved_model(source: Path) -> RssiModel | None:
    """Return the RSSI model in a file or in the directory of a run; None if the source is no model.

    Raises:
        InputError: A run without an RSSI model, or a model of which no map is written.
    """
    kept = model_file(source)
    if kept is None and isfile(source / CONFIG):
        raise InputError(f"{source} is a run without an RSSI model; name one of its models, {source}/....safetensors")
    file = kept or source
    if file.suffix != ".safetensors":
        return None
    model: Saved = load(file)
    model = model.model if isinstance(model, RssiLocator) else model
    if isinstance(model, RssiPredictor) and not isinstance(model, RssiModel):
        raise InputError(
            f"{file} holds {with_article(model.kind)}, of which no file is written; the report of its run shows its maps, "
            "and in Python its method predict gives RSSI at any position"
        )
    if isinstance(model, FieldModel):
        raise InputError(
            f"{file} predicts spectra at positions, not a map; use {command('predict', str(file), 'POSITIONS')}"
        )
    if not isinstance(model, RssiModel):
        raise InputError(f"{file} holds {with_article(model.kind)}, which predicts neither spectra nor RSSI")
    return model


def map_of(model: RssiModel, config: ConvertConfig) -> RssiMap:
    """Return the map of an RSSI model.

    Raises:
        InputError: An unknown receiver.
    """
    found = RssiMap.predict(model, config.cell, config.height)
    return found.receivers(config.rx) if config.rx else found


def write_file(data: Labelled, file: Path) -> str:
    """Write a file by its suffix, and return a description of it.

    Raises:
        InputError: A suffix of maps for other data, or a map in local metres as GeoJSON.
    """
    if file.suffix.lower() in MAPS:
        if not isinstance(data, RssiMap):
            raise InputError(f"{file.name} holds a map of RSSI, but the source is none; write .csv or .mat")
        return _write_map(data, file)
    if file.suffix.lower() == ".mat":
        write_mat(data, file)
        return f"{' and '.join(data.variables())}, with coordinates"
    table = data.to_frame()
    if table.index.name:
        table = table.reset_index()
    write_table(file, rounded(table.to_dict("records")))
    return f"{len(table)} rows"


def _write_map(data: RssiMap, file: Path) -> str:
    cells = Cells(data.x, data.y, data.cell, data.origin)
    bands = dict(zip(data.receiver_names, data.mean, strict=True))
    described = f"map of {len(cells.y)} x {len(cells.x)} cells of {data.cell:.3g} m"
    match file.suffix.lower():
        case ".tif":
            write_geotiff(file, bands, cells)
            return f"{described}, a band a receiver"
        case ".geojson":
            write_geojson(file, bands, cells)
            return described
    strongest = data.mean.max(axis=0)
    low, high = np.percentile(strongest, (1, 99)).tolist()
    with replacing(file) as temporary:
        colour_image(strongest[::-1], "viridis", low, max(high, low + 1)).save(temporary, "PNG")
    write_world_file(file.with_suffix(WORLD_FILE), cells)
    return f"{described}, strongest RSSI from {low:.0f} dBm (dark) to {high:.0f} dBm (bright)"
