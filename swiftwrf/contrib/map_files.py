"""Maps of predicted RSSI in files of geographic information systems.

A GeoTIFF contains local metres and their azimuthal equidistant projection, so it is exact. GeoJSON and world files contain
longitude and latitude (WGS84).
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from swiftwrf.data.coordinates import GeodeticOrigin
from swiftwrf.errors import InputError, optional_module
from swiftwrf.rssi.maps import RssiMap
from swiftwrf.runtime.durable import write_bytes, write_text

DEGREE_DECIMALS = 8  # of coordinates in GeoJSON: 1 mm


def write_geotiff(file: Path, data: RssiMap) -> None:
    """Write a map as a GeoTIFF of float32 with a band for each receiver; nan is no data.

    Raises:
        InputError: rasterio (extra `formats`) is missing.
    """
    rasterio = optional_module("rasterio", f"{file.name} is a GeoTIFF, which rasterio writes", "formats")
    west, _, _, north = data.corners
    place = 'LOCAL_CS["local metres",UNIT["metre",1]]'
    if data.origin is not None:
        from pyproj.crs import ProjectedCRS  # takes a moment, and most data are in metres
        from pyproj.crs.coordinate_operation import AzimuthalEquidistantConversion

        place = ProjectedCRS(AzimuthalEquidistantConversion(*data.origin), geodetic_crs="EPSG:4326").to_wkt()
    options = {
        "driver": "GTiff",
        "count": len(data.mean),
        "height": len(data.y),
        "width": len(data.x),
        "dtype": "float32",
        "nodata": math.nan,
        "crs": place,
        "transform": rasterio.Affine(data.cell, 0, west, 0, -data.cell, north),
        "compress": "deflate",
    }
    with rasterio.MemoryFile() as memory:
        with memory.open(**options) as image:
            image.write(data.mean[:, ::-1].astype("float32"))
            image.descriptions = data.receiver_names
        write_bytes(file, memory.read())


def write_geojson(file: Path, data: RssiMap) -> None:
    """Write a GeoJSON collection (RFC 7946) with one square for each cell, whose properties are the RSSI by receiver.

    Values are written with 2 decimals, nan as null.

    Raises:
        InputError: A map in local metres.
    """
    if data.origin is None:
        raise InputError(
            f"{file.name} needs latitude and longitude, but the data are in local metres; write .tif, .png or .csv"
        )
    x0, x1, y0, y1 = data.corners
    _, rows, columns = data.mean.shape
    corner = np.stack(np.meshgrid(np.linspace(x0, x1, columns + 1), np.linspace(y0, y1, rows + 1)), axis=-1)
    degrees = data.origin.to_degrees(corner.reshape(-1, 2))[:, ::-1].round(DEGREE_DECIMALS).reshape(corner.shape)
    squares = np.stack(
        [degrees[:-1, :-1], degrees[:-1, 1:], degrees[1:, 1:], degrees[1:, :-1], degrees[:-1, :-1]], axis=2
    )
    values = data.mean.astype(np.float64).round(2)
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Polygon", "coordinates": [squares[row, column].tolist()]},
            "properties": {
                name: None if np.isnan(value) else float(value)
                for name, value in zip(data.receiver_names, values[:, row, column], strict=True)
            },
        }
        for row, column in np.ndindex(rows, columns)
    ]
    write_text(file, json.dumps({"type": "FeatureCollection", "features": features}, ensure_ascii=False))


def write_world_file(
    file: Path, corners: tuple[float, float, float, float], size: tuple[int, int], origin: GeodeticOrigin | None = None
) -> None:
    """Write the world file of an image, the northernmost row on top.

    It contains longitude and latitude (WGS84), exact in the middle of the image, or x and y [m] without an origin.

    Args:
        file: File to write.
        corners: Edges x0, x1, y0, y1 of the image [m].
        size: Numbers of its columns and rows.
        origin: Origin of the metres. Defaults to none.
    """
    (x0, x1, y0, y1), (columns, rows) = corners, size
    pixel = np.array([[0.0, 0.0], [(x1 - x0) / columns, 0.0], [0.0, -(y1 - y0) / rows]])
    place = np.array([[(x0 + x1) / 2, (y0 + y1) / 2]]) + pixel
    if origin is not None:
        place = origin.to_degrees(place)[:, ::-1]
    along_row, along_column = place[1:] - place[0]
    first = place[0] - along_row * (columns - 1) / 2 - along_column * (rows - 1) / 2
    numbers = (*along_row.tolist(), *along_column.tolist(), *first.tolist())
    write_text(file, "".join(f"{number:.12g}\n" for number in numbers))
