"""Maps as files of geographic information systems: GeoTIFF, GeoJSON and world files, written without further libraries.

A GeoTIFF contains local metres and their azimuthal equidistant projection, so it is exact. GeoJSON and world files contain
longitude and latitude (WGS84).
"""

from __future__ import annotations

import io
import json
import zlib
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from swiftwrf.data.coordinates import GeodeticOrigin
from swiftwrf.errors import InputError
from swiftwrf.rssi.maps import RssiMap
from swiftwrf.runtime.durable import write_bytes, write_text

DEGREE_DECIMALS = 8  # of coordinates in GeoJSON: 1 mm
SHORT, LONG, DOUBLE, ASCII = 3, 4, 12, 2  # types of TIFF values
USER_DEFINED, WGS84, METRE, DEGREE, AZIMUTHAL_EQUIDISTANT = 32767, 4326, 9001, 9102, 12  # codes of GeoTIFF 1.1


def write_geotiff(file: Path, data: RssiMap) -> None:
    """Write a map as a GeoTIFF of float32 with a band for each receiver; nan is no data."""
    pixels = zlib.compress(np.moveaxis(data.mean[:, ::-1], 0, -1).astype("<f4").tobytes())
    west, _, _, north = data.corners
    names = "".join(  # GDAL escapes descriptions twice
        f'<Item name="DESCRIPTION" sample="{number}" role="description">{escape(escape(name))}</Item>'
        for number, name in enumerate(data.receiver_names)
    )
    keys, numbers = _geo_keys(data.origin)
    n, rows, columns = data.mean.shape
    tags: list[tuple[int, int, Any]] = [
        (256, LONG, [columns]),  # width
        (257, LONG, [rows]),  # length
        (258, SHORT, [32] * n),  # bits of a sample
        (259, SHORT, [8]),  # compression: deflate
        (262, SHORT, [1]),  # photometric interpretation: black is zero
        (273, LONG, [0]),  # offset of the only strip, after the directory
        (277, SHORT, [n]),  # samples of a pixel
        (278, LONG, [rows]),  # rows of a strip
        (279, LONG, [len(pixels)]),  # bytes of the strip
        (284, SHORT, [1]),  # planar configuration: the bands of a pixel follow each other
        (338, SHORT, [0] * (n - 1)),  # extra samples
        (339, SHORT, [3] * n),  # sample format: floating point
        (33550, DOUBLE, [data.cell, data.cell, 0.0]),  # scale of a pixel
        (33922, DOUBLE, [0.0, 0.0, 0.0, west, north, 0.0]),  # pixel 0, 0 and its place
        (34735, SHORT, keys),
        (34736, DOUBLE, numbers),
        (42112, ASCII, f"<GDALMetadata>{names}</GDALMetadata>".encode()),
        (42113, ASCII, "nan"),  # no data
    ]
    directory, stream = ImageFileDirectory_v2(), io.BytesIO()
    for tag, kind, values in tags:
        if len(values):
            directory.tagtype[tag] = kind
            directory[tag] = values
    directory.save(stream)
    write_bytes(file, stream.getvalue() + pixels)


def _geo_keys(origin: GeodeticOrigin | None) -> tuple[list[int], list[float]]:
    """Return the directory of GeoTIFF keys and their doubles."""
    keys = [(1024, 0, USER_DEFINED), (1025, 0, 1), (3076, 0, METRE)]  # kind of model, pixel is area, linear unit
    numbers: list[float] = []
    if origin is not None:
        numbers = [origin.latitude, origin.longitude, 0.0, 0.0]
        keys = [
            (1024, 0, 1),  # projected
            (1025, 0, 1),
            (2048, 0, WGS84),
            (2054, 0, DEGREE),
            (3072, 0, USER_DEFINED),
            (3074, 0, USER_DEFINED),
            (3075, 0, AZIMUTHAL_EQUIDISTANT),
            (3076, 0, METRE),
            (3082, 34736, 2),  # false easting
            (3083, 34736, 3),  # false northing
            (3088, 34736, 1),  # longitude of the centre
            (3089, 34736, 0),  # latitude of the centre
        ]
    entries = [(key, location, 1, value) for key, location, value in keys]
    return [1, 1, 1, len(entries), *(number for entry in entries for number in entry)], numbers


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


def write_world_file(file: Path, data: RssiMap) -> None:
    """Write the world file of an image of a map, the northernmost row on top.

    It contains longitude and latitude (WGS84), exact in the middle of the map, or x and y [m] without an origin.
    """
    x0, x1, y0, y1 = data.corners
    place = np.array([[(x0 + x1) / 2, (y0 + y1) / 2]]) + data.cell * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, -1.0]])
    if data.origin is not None:
        place = data.origin.to_degrees(place)[:, ::-1]
    along_row, along_column = place[1:] - place[0]
    first = place[0] - along_row * (len(data.x) - 1) / 2 - along_column * (len(data.y) - 1) / 2
    numbers = (*along_row.tolist(), *along_column.tolist(), *first.tolist())
    write_text(file, "".join(f"{number:.12g}\n" for number in numbers))
