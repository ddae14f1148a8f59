"""Tables, data sets, MATLAB files, maps and DeepMIMO folders are read back by the programs that they are for."""

import json
from dataclasses import replace
from xml.etree import ElementTree
from xml.sax.saxutils import unescape

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image
from quick import command, said
from samples import FREQUENCY, snapshots
from scipy.io import loadmat
from sklearn.neighbors import KNeighborsRegressor
from tifffile import TiffFile, imread

from swiftwrf import AngularGrid, RssiModel, Spectra, load_spectra, make_model, rssi_room
from swiftwrf.contrib.formats.deepmimo import write_deepmimo
from swiftwrf.contrib.map_files import write_geojson, write_geotiff, write_world_file
from swiftwrf.data.coordinates import GeodeticOrigin
from swiftwrf.data.simulated import ShoeboxRoom
from swiftwrf.data.writing import write_mat, write_paths, write_rssi, write_spectra
from swiftwrf.rssi.maps import RssiMap

GRID = AngularGrid.hemisphere(8, 32)
ORIGIN = GeodeticOrigin(48.1, 11.6)


def run(*arguments):
    return command("convert", *arguments)


@pytest.fixture(scope="module")
def floor():
    return rssi_room(n=60)


@pytest.fixture(scope="module")
def model(floor):
    return RssiModel(n_primitives=0).fit(floor.columns([0, 4]))


@pytest.fixture(scope="module")
def geodetic(floor, model):
    """A model of positions that were projected from degrees."""
    return RssiModel(n_primitives=0).fit(replace(floor.columns([0, 4]), origin=ORIGIN))


@pytest.fixture(scope="module")
def field(room):
    return make_model("idw").fit(room)


@pytest.mark.parametrize("container", [np.asarray, pd.DataFrame, lambda x: x.tolist(), lambda x: x[::-1][::-1]])
def test_positions_may_be_arrays(field, model, room, container):
    position = room.position[:3]
    given = container(position.numpy())
    assert torch.equal(field.predict(given).mean, field.predict(position).mean)
    assert torch.equal(field.synthesize(given), field.synthesize(position))
    assert torch.equal(model.predict(given).mean, model.predict(position).mean)
    assert torch.equal(room.direction_at(given), room.direction_at(position))


def test_arrays_in_and_out_as_in_scikit_learn(floor, room):
    x, y = floor.columns([0]).receivers(["1"]).to_numpy()
    known = ~np.isnan(y[:, 0])
    fitted = KNeighborsRegressor(1).fit(x[known], y[known])
    np.testing.assert_allclose(fitted.predict(x[known]), y[known])
    x, y = room.to_numpy()
    again = Spectra(y, x)
    assert torch.equal(again.spectrum, room.spectrum)
    assert torch.equal(again.position, room.position)
    assert snapshots(n=12).to_numpy()[1].shape == (12, 3, 16)


def test_predictions_become_tables(field, model, room):
    position = room.position[:3]
    table, found = model.predict(position).to_frame(), model.predict(position)
    assert list(table) == ["x_m", "y_m", "z_m", "receiver", "predicted_dbm", "std_db"]
    cells = RssiMap.predict(model, cell=4.0)
    frame = cells.to_frame().query("receiver == @model.receiver_names[1]").pivot(index="y_m", columns="x_m")
    assert (frame.index.tolist(), frame["std_db"].columns.tolist()) == (cells.y.tolist(), cells.x.tolist())
    np.testing.assert_array_equal(frame["std_db"], cells.std[1])
    second = table[table["receiver"] == model.receiver_names[1]]
    np.testing.assert_array_equal(second["predicted_dbm"], found.mean[:, 1].numpy())
    np.testing.assert_array_equal(second[["x_m", "y_m", "z_m"]], position.numpy())
    spectra = field.predict(position)
    peak = room.grid.peak_direction(spectra.mean).rad2deg().numpy()
    np.testing.assert_array_equal(spectra.to_frame()[["azimuth_deg", "elevation_deg"]], peak)


def test_data_sets_have_coordinates_and_units(field, model, geodetic, room, floor):
    pytest.importorskip("xarray", reason="needs the extra xarray")
    measured = room.to_xarray()
    assert measured.spectrum.dims == ("position", "elevation", "azimuth")
    near = measured.spectrum.isel(position=4).sel(azimuth=90, elevation=48, method="nearest")
    assert float(near) == float(room.spectrum[4, 7, 15])
    assert (measured.x.attrs["units"], measured.azimuth.attrs["units"]) == ("m", "degree")
    rssi = floor.to_xarray()
    name = floor.receiver_names[2]
    np.testing.assert_array_equal(rssi.rssi.sel(receiver=name), floor.rssi_dbm[:, 2].numpy())
    assert rssi.rssi.attrs["units"] == "dBm"
    predicted = field.predict(room.position[:2]).to_xarray()
    np.testing.assert_array_equal(predicted.y, room.position[:2, 1].numpy())
    assert set(model.predict(room.position[:2]).to_xarray()) == {"rssi", "std"}
    chart = RssiMap.predict(geodetic, cell=1.0).to_xarray()
    assert chart.rssi.dims == ("receiver", "y", "x")
    back = ORIGIN.to_metres(np.stack([chart.latitude, chart.longitude], axis=-1).reshape(-1, 2))
    np.testing.assert_allclose(back[:, 0], np.broadcast_to(chart.x, chart.latitude.shape).ravel(), atol=1e-6)
    assert snapshots(n=12).to_xarray().channel.dims == ("position", "snapshot", "element")


def test_matlab_files_hold_spectra_and_predictions(field, room, tmp_path):
    write_mat(room, tmp_path / "spectra.mat")
    stored = loadmat(tmp_path / "spectra.mat")
    np.testing.assert_array_equal(stored["spectrum"], room.spectrum.numpy())
    np.testing.assert_array_equal(stored["x"][:, 0], room.position[:, 0].numpy())
    np.testing.assert_allclose(stored["azimuth"][:, 0], 6.0 * np.arange(60))
    prediction = field.predict(room.position[:2])
    write_mat(prediction, tmp_path / "prediction.mat")
    np.testing.assert_array_equal(loadmat(tmp_path / "prediction.mat")["spectrum"], prediction.mean.numpy())


def test_measurements_become_tables(room, floor, tmp_path):
    for data, write in ((room, write_spectra), (floor, write_rssi)):
        (tmp_path / data.name).mkdir()
        write(data, tmp_path / data.name)
        out = tmp_path / f"{data.name}.csv"
        assert run(tmp_path / data.name, out) == 0
        table = pd.read_csv(out, index_col="index")
        assert list(table) == list(data.to_frame())
        np.testing.assert_allclose(table["x_m"], data.to_frame()["x_m"], atol=0.000501)


def test_a_geotiff_has_values_place_and_projection(geodetic, tmp_path):
    """The reader is another library than the writer."""
    one = RssiMap.predict(geodetic, cell=1.5).receivers(geodetic.receiver_names[:1])
    write_geotiff(tmp_path / "a.tif", replace(one, receiver_names=("hall & <stairs>",), origin=ORIGIN))
    with TiffFile(tmp_path / "a.tif") as image:
        keys, metadata = image.geotiff_metadata, image.pages[0].tags["GDAL_METADATA"].value
        np.testing.assert_array_equal(image.asarray(), one.mean[0, ::-1])
    # a pixel and its place; whole numbers are corners of pixels (raster type: area)
    (column, row, _, x, y, _), (dx, dy, _) = keys["ModelTiepoint"], keys["ModelPixelScale"]
    assert keys["GTRasterTypeGeoKey"] == 1
    middle = np.arange(len(one.x)) + 0.5, np.arange(len(one.y)) + 0.5
    np.testing.assert_allclose(x + (middle[0] - column) * dx, one.x)
    np.testing.assert_allclose(y - (middle[1] - row) * dy, one.y[::-1])
    assert (keys["ProjCenterLatGeoKey"], keys["ProjCenterLongGeoKey"]) == (ORIGIN.latitude, ORIGIN.longitude)
    assert (keys["ProjCoordTransGeoKey"], keys["GeographicTypeGeoKey"]) == (12, 4326)  # azimuthal equidistant, WGS84
    (description,) = ElementTree.fromstring(metadata)
    assert unescape(description.text) == "hall & <stairs>"


def test_a_geotiff_has_a_band_for_each_receiver(model, tmp_path):
    chart = RssiMap.predict(model, cell=1.0)
    write_geotiff(tmp_path / "a.tif", chart)
    np.testing.assert_array_equal(imread(tmp_path / "a.tif").transpose(2, 0, 1), chart.mean[:, ::-1])


def test_geojson_has_a_square_a_cell_in_degrees(geodetic, tmp_path):
    geodetic.save(tmp_path / "model.safetensors")
    assert run(tmp_path / "model.safetensors", tmp_path / "map.geojson", "--cell", 2) == 0
    found, chart = json.loads((tmp_path / "map.geojson").read_text()), RssiMap.predict(geodetic, cell=2.0)
    rows, columns = len(chart.y), len(chart.x)
    assert (found["type"], len(found["features"])) == ("FeatureCollection", rows * columns)
    cell = found["features"][columns + 3]
    (ring,) = cell["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    xy = ORIGIN.to_metres(np.array(ring)[:4, ::-1])
    np.testing.assert_allclose(xy.mean(axis=0), (chart.x[3], chart.y[1]), atol=0.005)
    east, north = xy[1] - xy[0], xy[2] - xy[1]
    assert east[0] * north[1] > 0  # counter-clockwise
    assert cell["properties"][chart.receiver_names[1]] == pytest.approx(chart.mean[1, 1, 3], abs=0.00501)


@pytest.mark.parametrize("with_origin", [True, False])
def test_an_image_has_a_world_file(geodetic, model, with_origin, tmp_path):
    chosen = geodetic if with_origin else model
    chosen.save(tmp_path / "model.safetensors")
    assert run(tmp_path, tmp_path / "map.png", "--cell", 0.5) == 0
    chart = RssiMap.predict(chosen, cell=0.5)
    x_column, y_column, x_row, y_row, x, y = map(float, (tmp_path / "map.pgw").read_text().split())
    with Image.open(tmp_path / "map.png") as image:
        luminance = np.asarray(image.convert("L"), dtype=float)
    shown = chart.detection.max(axis=0) > 0.6  # not hatched
    cells = np.stack(np.meshgrid(chart.x, chart.y), axis=-1)[shown]
    place = ORIGIN.to_degrees(cells)[:, ::-1] if with_origin else cells
    column, row = np.linalg.solve([[x_column, x_row], [y_column, y_row]], (place - (x, y)).T).round().astype(int)
    strongest = chart.mean.max(axis=0)[shown]
    assert np.corrcoef(luminance[row, column], strongest)[0, 1] > 0.95
    edge = np.linalg.solve([[x_column, x_row], [y_column, y_row]], (place.max(axis=0) - (x, y)))
    assert 0 < edge[1] < len(luminance) / 4  # the northernmost cells are at the top, below the title
    assert luminance.shape[1] > 1000


def chart_of(x, y, cell, rssi, origin=None):
    rssi = np.array(rssi, dtype=np.float32).reshape(1, len(y), len(x))
    return RssiMap(np.array(x), np.array(y), 1.0, cell, rssi, rssi, rssi, ("hall",), origin)


def test_a_map_is_hatched_where_nothing_is_received_at_the_median_height(model, floor, monkeypatch):
    hatched = []
    monkeypatch.setattr("swiftwrf.rssi.maps.hatch", lambda ax, x, y, where: hatched.append(where))
    chart = RssiMap.predict(model, cell=4.0)
    detection = np.linspace(0, 1, chart.mean.size).reshape(chart.mean.shape)
    image = replace(chart, detection=detection).plot().images[0]
    assert (image.origin, tuple(image.get_extent())) == ("lower", chart.corners)
    assert np.array_equal(image.get_array(), chart.mean.max(axis=0))
    assert np.array_equal(hatched[0], (detection < 0.5).all(axis=0))
    assert chart.height == pytest.approx(np.median(floor.transmitter_position[:, 2]), abs=0.01)
    assert RssiMap.predict(model, cell=2.0, region=[[1.0, 2.0], [9.0, 8.0]]).corners == (1, 9, 2, 8)


def test_a_world_file_of_one_cell_has_its_size(tmp_path):
    write_world_file(tmp_path / "a.pgw", (2.0, 4.0, 3.0, 5.0), (1, 1))
    assert list(map(float, (tmp_path / "a.pgw").read_text().split())) == [2, 0, 0, -2, 3, 4]


def test_cells_without_a_value_are_null_in_geojson(tmp_path):
    write_geojson(tmp_path / "a.geojson", chart_of([0.0, 1.0], [0.0], 1.0, [np.nan, -50.126], ORIGIN))
    values = [f["properties"]["hall"] for f in json.loads((tmp_path / "a.geojson").read_text())["features"]]
    assert values == [None, -50.13]


def paths_of(receiver, transmitter, **room):
    return ShoeboxRoom(frequency_hz=FREQUENCY, **room).paths(torch.tensor([transmitter]), receiver)


AROUND = torch.tensor([0.5, 0.5, 0.6]) + torch.tensor([5.0, 4.0, 1.0]) * torch.rand(
    30, 3, generator=torch.Generator().manual_seed(0)
)
PATHS = {
    "above": paths_of(AROUND, [3.0, 2.5, 2.7]),
    "below": paths_of(torch.tensor([[1.0, 1.0, 2.0], [4.0, 3.0, 2.2]]), [3.0, 2.5, 0.4], boxes=()),
}


@pytest.mark.parametrize("place", PATHS)
def test_deepmimo_folders_come_back(tmp_path, place):
    paths = PATHS[place]
    write_deepmimo(paths, tmp_path)
    found, expected = load_spectra(tmp_path, grid=GRID), paths.spectra("made", grid=GRID)
    torch.testing.assert_close(found.spectrum, expected.spectrum, atol=1e-6, rtol=0)
    torch.testing.assert_close(found.label, expected.label, atol=1e-9, rtol=0)
    torch.testing.assert_close(found.position, expected.position)
    assert torch.equal(found.line_of_sight, expected.line_of_sight)
    assert (found.moving, found.notes) == ("receiver", ())
    assert bool(found.line_of_sight.all()) == (place == "below")
    with np.load(next(tmp_path.glob("aoa_el*.npz"))) as angles:
        assert (angles["aoa_el"][:, 0] > 90).all() == (place == "below")  # the direct paths


def test_deepmimo_folders_are_made_of_ray_paths(tmp_path, capsys):
    paths = PATHS["above"]
    corner = paths.receiver[paths.owner] + paths.direction
    made = replace(paths, corner=corner[:, None])
    for name, some in (("known", made), ("unknown", replace(made, length=None))):
        (tmp_path / name).mkdir()
        write_paths(some, tmp_path / name)
    assert run(tmp_path / "known", tmp_path / "town", "--deepmimo") == 0
    found, expected = (load_spectra(tmp_path / name, grid=GRID).spectrum for name in ("town", "known"))
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)
    capsys.readouterr()
    assert run(tmp_path / "unknown", tmp_path / "other", "--deepmimo") == 2
    assert "lengths of these paths are unknown" in said(capsys)
    assert not (tmp_path / "other").exists()
