"""Maps as files of geographic information systems: GeoTIFF, GeoJSON and world files, written without further libraries.

A GeoTIFF contains local metres and their azimuthal equidistant projection, so it is exact. GeoJSON and world files contain
longitude and latitude (WGS84).
"""

from __future__ import annotations

import io
import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from swiftwrf.data.coordinates import GeodeticOrigin
from swiftwrf.errors import InputError
from swiftwrf.runtime.durable import write_bytes, write_text

Floats = NDArray[np.floating]
DEGREE_DECIMALS = 8  # of coordinates in GeoJSON: 1 mm
SHORT, LONG, DOUBLE, ASCII = 3, 4, 12, 2  # types of TIFF values
USER_DEFINED, WGS84, METRE, DEGREE, AZIMUTHAL_EQUIDISTANT = 32767, 4326, 9001, 9102, 12  # codes of GeoTIFF 1.1


class Cells(NamedTuple):
    """Square cells of a map.

    Args:
        x: Centres of the columns, ascending, (columns,) [m].
        y: Centres of the rows, ascending, (rows,) [m].
        edge: Edge of a cell [m].
        origin: Latitude and longitude of x = y = 0. None for local metres.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    edge: float
    origin: GeodeticOrigin | None = None


def write_geotiff(file: Path, bands: Mapping[str, Floats], cells: Cells) -> None:
    """Write bands (rows, columns) by name as a GeoTIFF of float32. Their rows run from south to north, nan is no data."""
    pixels = zlib.compress(np.stack([band[::-1] for band in bands.values()], axis=-1).astype("<f4").tobytes())
    west, north = cells.x[0] - cells.edge / 2, cells.y[-1] + cells.edge / 2
    names = "".join(  # GDAL escapes descriptions twice
        f'<Item name="DESCRIPTION" sample="{number}" role="description">{escape(escape(name))}</Item>'
        for number, name in enumerate(bands)
    )
    keys, numbers = _geo_keys(cells.origin)
    n = len(bands)
    tags: list[tuple[int, int, Any]] = [
        (256, LONG, [len(cells.x)]),  # width
        (257, LONG, [len(cells.y)]),  # length
        (258, SHORT, [32] * n),  # bits of a sample
        (259, SHORT, [8]),  # compression: deflate
        (262, SHORT, [1]),  # photometric interpretation: black is zero
        (273, LONG, [0]),  # offset of the only strip, after the directory
        (277, SHORT, [n]),  # samples of a pixel
        (278, LONG, [len(cells.y)]),  # rows of a strip
        (279, LONG, [len(pixels)]),  # bytes of the strip
        (284, SHORT, [1]),  # planar configuration: the bands of a pixel follow each other
        (338, SHORT, [0] * (n - 1)),  # extra samples
        (339, SHORT, [3] * n),  # sample format: floating point
        (33550, DOUBLE, [cells.edge, cells.edge, 0.0]),  # scale of a pixel
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


def write_geojson(file: Path, bands: Mapping[str, Floats], cells: Cells) -> None:
    """Write a GeoJSON collection (RFC 7946) with one square for each cell, whose properties are the values by band.

    Rows of the bands run from south to north, nan is no data. Values are written with 2 decimals.

    Raises:
        InputError: Cells in local metres.
    """
    if cells.origin is None:
        raise InputError(
            f"{file.name} needs latitude and longitude, but the data are in local metres; write .tif, .png or .csv"
        )
    edges = [np.append(centres - cells.edge / 2, centres[-1] + cells.edge / 2) for centres in (cells.x, cells.y)]
    corner = np.stack(np.meshgrid(*edges), axis=-1)
    degrees = cells.origin.to_degrees(corner.reshape(-1, 2))[:, ::-1].round(DEGREE_DECIMALS).reshape(corner.shape)
    squares = np.stack(
        [degrees[:-1, :-1], degrees[:-1, 1:], degrees[1:, 1:], degrees[1:, :-1], degrees[:-1, :-1]], axis=2
    )
    values = {name: band.astype(np.float64).round(2) for name, band in bands.items()}
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Polygon", "coordinates": [squares[row, column].tolist()]},
            "properties": {
                name: None if np.isnan(band[row, column]) else float(band[row, column]) for name, band in values.items()
            },
        }
        for row, column in np.ndindex(len(cells.y), len(cells.x))
    ]
    write_text(file, json.dumps({"type": "FeatureCollection", "features": features}, ensure_ascii=False))


def write_world_file(file: Path, cells: Cells) -> None:
    """Write the world file of an image of the cells, the northernmost row on top.

    It contains longitude and latitude (WGS84), exact in the middle of the map, or x and y [m] without an origin.
    """
    middle = np.array([(cells.x[0] + cells.x[-1]) / 2, (cells.y[0] + cells.y[-1]) / 2])
    place = middle + cells.edge * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, -1.0]])
    if cells.origin is not None:
        place = cells.origin.to_degrees(place)[:, ::-1]
    along_row, along_column = place[1:] - place[0]
    first = place[0] - along_row * (len(cells.x) - 1) / 2 - along_column * (len(cells.y) - 1) / 2
    numbers = (*along_row.tolist(), *along_column.tolist(), *first.tolist())
    write_text(file, "".join(f"{number:.12g}\n" for number in numbers))
