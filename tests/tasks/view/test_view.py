"""Content of the page without widgets: views, plans, spectra, maps and refusals."""

import asyncio
import base64
import copy
import io
import json
import shutil
import socket
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import quick
import small
import torch
from fuzz import kinds
from PIL import Image
from scipy.optimize import linprog
from scipy.spatial.distance import cdist
from scipy.stats import norm

from swiftwrf import AngularGrid, InputError, PairModel, Rssi, RssiModel, load_rssi, rssi_room
from swiftwrf.contrib.online import Follower
from swiftwrf.locate import MatchedField, RssiLocator
from swiftwrf.models.geometry import Plane
from swiftwrf.rssi.coverage import reach
from swiftwrf.rssi.maps import RssiMap
from tasks.configs import LocateConfig
from tasks.convert import saved_model
from tasks.options import by_name
from tasks.page.maps import FloorPlan, colour_image
from tasks.update.record import Record, snapshot
from tasks.view import charts, spectra
from tasks.view.locating import RssiLocating
from tasks.view.rssi import MapSelection, RssiView
from tasks.view.sources import open_source

GRID = AngularGrid.hemisphere(15, 60)
needs_the_extra = pytest.mark.skipif(find_spec("nicegui") is None, reason="needs the extra view")


@pytest.mark.parametrize("pixel", [(0, 0), (3, 10), (7, 59), (13, 31)])
def test_a_direction_is_drawn_where_it_is_marked(pixel):
    """The picture lies on axes of azimuth and elevation, or seen along the normal in a square around the disc."""
    spectrum = np.zeros(GRID.shape)
    spectrum[pixel] = 1
    azimuth, elevation = float(GRID.azimuth[pixel[1]].rad2deg()), float(GRID.elevation[pixel[0]].rad2deg())
    values, (x0, x1, y0, y1) = charts.rectangle(spectrum, GRID)
    row, column = (values == 1).nonzero()
    x = x0 + (column + 0.5) / values.shape[1] * (x1 - x0)
    y = y1 - (row + 0.5) / values.shape[0] * (y1 - y0)
    assert np.hypot(x - azimuth, y - elevation).min() < 1e-6
    assert (x0 <= 0, x1 >= 360, y0 <= 0, y1 >= 90) == (True,) * 4
    row, column = (charts.disc(spectrum, GRID) == 1).nonzero()
    right, up = (column + 0.5) / charts.DISC_PX * 2 - 1, 1 - (row + 0.5) / charts.DISC_PX * 2
    radius, angle = 1 - elevation / 90, np.deg2rad(azimuth)
    assert np.hypot(right - radius * np.cos(angle), up - radius * np.sin(angle)).min() < 3 / charts.DISC_PX


def test_polar_view_is_clear_outside_the_hemisphere():
    shown = charts.disc(np.ones(GRID.shape), GRID)
    assert np.isnan(shown[0, 0])
    assert np.isfinite(shown).mean() == pytest.approx(np.pi / 4, abs=0.01)


def test_pictures_have_the_ends_of_the_colours_and_clear_pixels():
    image = colour_image(np.array([[0.0, 1.0, np.nan, 7.0]]), "viridis")
    ((*place, width, height, opacity, address),) = charts.picture(image, (0, 4, 0, 1), 0.5)
    assert (place, width, height, opacity) == ([0, 4, 0, 1], 4, 1, 0.5)
    content = base64.b64decode(address.removeprefix("data:image/png;base64,"))
    pixels = np.asarray(Image.open(io.BytesIO(content)).convert("RGBA"))[0]
    np.testing.assert_allclose(pixels[:, 3], [255, 255, 0, 255])
    np.testing.assert_allclose(pixels[[0, 1], :3], [[68, 1, 84], [253, 231, 37]], atol=2)
    assert (pixels[3] == pixels[1]).all()


@needs_the_extra
def test_texts_are_texts():
    from tasks.view.page import legend

    assert "<script>" not in legend([("red", "●", "<script>")])


@pytest.mark.parametrize(
    ("extend", "ends"), [("neither", ["3  dB", "1"]), ("max", ["≥ 3  dB", "1"]), ("both", ["≥ 3  dB", "≤ 1"])]
)
def test_open_scales_are_written_as_such(extend, ends):
    assert charts.colour_bar("viridis", (1, 3), "dB", "map", extend)["text"] == ends


def test_view_of_a_run(aoa_run, room):
    view = open_source(aoa_run)
    assert [loaded.title for loaded in view.models] == ["swiftwrf, 50% measured", "swiftwrf, 100% measured"]
    train, test = room.split("random", 0)
    assert [int(loaded.in_training.sum()) for loaded in view.models] == [round(0.5 * len(train)), len(train)]
    assert not view.models[1].in_training[test.index].any()
    np.testing.assert_allclose(view.data.position, room.position, atol=1e-6)
    assert (view.positions == view.start).all(axis=1).any()


def test_predicted_spectrum_is_that_of_the_model(aoa_run):
    view = open_source(aoa_run)
    loaded, at = view.models[0], np.array([3.0, 2.5, 1.1])
    shown = view.predict(loaded, at)
    predicted = loaded.model.predict(torch.from_numpy(at)[None])
    np.testing.assert_allclose(shown.mean, predicted.mean[0].detach(), atol=1e-4)
    np.testing.assert_allclose(shown.std, predicted.std[0].detach(), atol=1e-5)
    row, column = np.unravel_index(shown.mean.argmax(), GRID.shape)
    peak = float(GRID.azimuth[column].rad2deg()), float(GRID.elevation[row].rad2deg())
    assert shown.peak == pytest.approx(peak)
    direction = view.data.direction_at(torch.from_numpy(at)[None])[0].rad2deg()
    assert shown.line_of_sight == pytest.approx(tuple(direction.tolist()))
    assert view.predict(view.models[1], at).std is None


def test_nearest_measured_spectrum(aoa_run, room):
    view = open_source(aoa_run)
    at = room.position[7].numpy() + np.array([0, 0, 0.001])
    index, away_m = view.nearest(at)
    assert index == 7
    assert away_m == pytest.approx(0.001, abs=1e-5)
    np.testing.assert_allclose(view.data.store[7:8][0], room.spectrum[7], atol=1 / 255)


@pytest.mark.parametrize(("seconds", "shape"), [(1e9, (15, 60)), (0.0, (1, 4))])
def test_a_slow_model_is_dragged_on_a_coarser_grid(aoa_run, monkeypatch, seconds, shape):
    monkeypatch.setattr(spectra, "MAX_DRAG_SECONDS", seconds)
    view = open_source(aoa_run)
    shown = view.predict(view.models[0], view.start, dragging=True)
    assert shown.grid.shape == shown.mean.shape == shown.std.shape == shape
    assert view.predict(view.models[0], view.start).mean.shape == (15, 60)


@pytest.mark.parametrize("name", [name for name in kinds.MODELS if name.endswith(" model") and "rssi" not in name])
def test_a_model_by_itself(tmp_path, name):
    kinds.save(name, tmp_path)
    view = open_source(tmp_path / "model")
    shown = view.predict(view.models[0], view.start, dragging=True)
    assert np.isfinite(shown.mean).all()
    assert (view.positions.min(axis=0) <= view.start).all()
    assert (view.start <= view.positions.max(axis=0)).all()
    assert shown.line_of_sight is not None  # models store the link of their training spectra
    assert bool(view.models[0].planes) == (name in ("geometry model", "hybrid model"))


def test_far_ends_leave_room_to_drag(aoa_run):
    view = open_source(aoa_run)
    low, high = view.box
    assert (low <= view.fixed).all()
    assert (view.fixed <= high).all()
    far = replace(view, data=replace(view.data, fixed_position=torch.tensor([100.0, 2, 1])))
    width = np.ptp(view.positions, axis=0).max()
    assert far.box[1][0] == pytest.approx(view.positions[:, 0].max() + spectra.MAX_BEYOND_DATA * width)


def test_measurements_that_changed_or_went_are_not_shown(aoa_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(aoa_run, folder)
    environment = json.loads((folder / "environment.json").read_text())
    environment["input_sha256"]["scene box.xml"] = "of a scene that was traced"
    (folder / "environment.json").write_text(json.dumps(environment))
    assert open_source(folder).data is not None
    for file, key, value in (("environment.json", "input_sha256", {}), ("config.json", "data", str(tmp_path / "gone"))):
        content = json.loads((folder / file).read_text())
        content.get("config", content)[key] = value
        (folder / file).write_text(json.dumps(content))
        view = open_source(folder)
        assert view.data is None
        assert len(view.notes) == 1
        assert np.isfinite(view.predict(view.models[0], view.start).mean).all()


def test_room_of_another_model_on_the_same_spectra(aoa_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(aoa_run, folder)
    plane = Plane((1.0, 0.0, 0.0), 6.0, -0.5, 1.0, 0.95, 6.1, dielectric=True).to_json()
    (folder / "geometry-mix1.json").write_text(json.dumps({"planes": [plane]}))
    assert [loaded.planes for loaded in open_source(folder).models] == [[], [plane]]


def test_visitors_at_other_heights_have_maps_of_their_own(monkeypatch):
    both = threading.Barrier(2)

    class SlowlyChanged(RssiView):
        def __setattr__(self, name, value):
            super().__setattr__(name, value)
            if threading.current_thread() is not threading.main_thread():
                both.wait(10)

    view = SlowlyChanged("room", RssiModel(n_primitives=0).fit(rssi_room(n=40)), rssi_room(n=40))
    monkeypatch.setattr(RssiMap, "predict", lambda *_, height, **options: SimpleNamespace(height=height))
    with ThreadPoolExecutor(2) as visitors:
        assert [chart.height for chart in visitors.map(view.map, (1.0, 2.0))] == [1.0, 2.0]


@pytest.fixture(scope="module")
def small_floor():
    """Fifty rows at three receivers, over a floor plan that is larger than where they are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("swiftwrf.rssi.maps.CELLS", 20)
        data = rssi_room(n=50).columns([0, 5, 11])
        view = RssiView("floor", RssiModel().fit(data), data)
        view.place(FloorPlan(np.zeros((2, 2, 3), np.uint8), (-30.0, 50.0, -20.0, 40.0)))
        yield view


@pytest.mark.parametrize(("receiver", "threshold", "certainty"), [(2, -67.0, 0.7), (0, -75.0, 0.8), (1, -75.0, 0.5)])
def test_what_the_page_says_of_a_receiver(small_floor, receiver, threshold, certainty):
    """Fractions are of the measured cells of the report, whatever the plan shows; the hull is that of another function."""
    view, selection = small_floor, MapSelection("coverage", receiver, 1.2, threshold, certainty)

    def above(chart):
        return chart.detection[receiver] * norm.sf(threshold, chart.mean[receiver], chart.std[receiver])

    chart, shown = RssiMap.predict(view.model, height=1.2, detected=True), view.map(1.2, detected=True)
    assert chart.mean.shape[1:] != shown.mean.shape[1:]
    cells, at = np.stack(np.meshgrid(chart.x, chart.y), axis=-1).reshape(-1, 2), view.position[:, :2]
    corners = np.vstack([at.T, np.ones(len(at))])
    hull = np.array([linprog(np.zeros(len(at)), A_eq=corners, b_eq=[*cell, 1]).success for cell in cells])
    measured = hull & (cdist(cells, at).min(axis=1) <= reach(view.model))
    assert measured.sum() < hull.sum() < len(cells)
    found, name, coloured = above(chart).ravel()[measured], view.receivers[receiver], view.coloured(selection)
    covered, away = f"{(found >= certainty).mean():.0%}", f"{1 - measured.sum() / hull.sum():.0%}"
    passed = f"{(view.rows.rssi_dbm[:, receiver] > threshold).double().mean():.0%} of the 50 scans pass the threshold"
    passing = f"{name} above {threshold:g} dBm with at least {certainty:.0%} probability"
    weak = f"{(found <= 1 - certainty).mean():.0%} is not covered (at most {1 - certainty:.0%})"
    assert coloured.sentence.startswith(f"{covered} of the measured area is covered ({passing}), {weak}")
    assert f"{passed}. {away} of the area between" in coloured.sentence
    strongest = RssiMap.predict(view.model, height=1.2).mean.argmax(axis=0).ravel()[measured]
    assert view.best(1.2) == pytest.approx({n: (strongest == n).mean() for n in np.unique(strongest)})
    first, part = next(iter(view.best(1.2).items()))
    best = view.coloured(MapSelection("best receiver", 0, 1.2)).sentence
    assert f"{view.receivers[first]} on {part:.0%} of the measured area" in best
    cells = np.stack(np.meshgrid(shown.x, shown.y), axis=-1).reshape(-1, 2)
    hull = np.array([linprog(np.zeros(len(at)), A_eq=corners, b_eq=[*cell, 1]).success for cell in cells])
    known = (hull & (cdist(cells, at).min(axis=1) <= reach(view.model))).reshape(above(shown).shape)
    uncertain = (above(shown) < certainty) & (above(shown) > 1 - certainty)
    classes = np.where(~known, 0, np.where(above(shown) >= certainty, 3, np.where(uncertain, 2, 1)))
    np.testing.assert_array_equal(coloured.values, classes)
    assert set(np.unique(classes)) >= {0, 3}
    table, mean = pd.read_csv(io.StringIO(view.table(selection))), view.map(1.2).mean
    np.testing.assert_allclose(table["predicted_dbm"], mean[receiver].ravel(), atol=0.006)
    words = np.array(["not measured", "not covered", "uncertain", "covered"])[classes.ravel()]
    assert table[f"above_{threshold:g}_dbm_with_{certainty:.0%}"].tolist() == words.tolist()
    assert list(table["best_receiver"]) == [view.receivers[number] for number in mean.argmax(axis=0).ravel()]
    i, j = np.argwhere(above(shown) >= certainty)[0]
    place = float(shown.x[j]), float(shown.y[i])
    text = view.describe(selection, *place)
    assert f"{name} above {threshold:g} dBm with {above(shown)[i, j]:.0%}" in text
    assert "one of 3 receivers above" in view.describe(replace(selection, at_least=1), *place)
    predicted = view.model.predict(torch.tensor([[*place, 1.2]], dtype=torch.float64))
    np.testing.assert_allclose(view.map(1.2).mean[:, i, j], predicted.mean[0], atol=1e-3)
    low, high = (float(end[0, receiver]) for end in predicted.interval(0.8))
    assert f"{name}: {predicted.mean[0, receiver]:.1f} dBm, 80% of measurements in [{low:.1f}, {high:.1f}] dBm" in text
    assert f"best receiver: {view.receivers[predicted.mean[0].argmax()]}" in text
    chance = [view.coverage(replace(selection, at_least=number)).probability.mean() for number in (0, 1, 2, 3)]
    assert chance[0] < chance[1] > chance[2] > chance[3]


def test_view_of_a_run_of_rssi_and_of_its_model(rssi_run):
    view, model = open_source(rssi_run), open_source(rssi_run / "model.safetensors")
    assert view.receivers == ("receiver01", "receiver06", "receiver12")
    assert view.plan.corners == (0, 20, 0, 15)
    assert np.isfinite(model.coloured(MapSelection("RSSI", 0, model.heights[1])).values).all()
    assert model.rows.rssi_dbm.isnan().all()
    assert "best receiver" in view.kinds
    view.model.receiver_names = view.receivers[:1]
    assert "best receiver" not in view.kinds


def test_floors_and_what_was_not_received_are_shown_apart():
    """Two floors, 40 dB of attenuation between them: nothing from above is detected."""
    room = rssi_room(n=120)
    position = room.transmitter_position.clone()
    upper = torch.arange(120) % 2 == 0
    position[upper, 2] += 3.5
    power = torch.where(upper, -95.0, room.rssi_dbm[:, 5].nan_to_num(-70.0))[:, None]
    table = pd.DataFrame(position.numpy(), columns=["x", "y", "z"])
    table["floor"], table["6"] = np.where(upper, "upper", "lower"), power.where(power > -85, torch.nan)[:, 0]
    data = Rssi.from_frame(table, receiver_position={"6": room.receiver_position[5].tolist()})
    view = RssiView("two floors", RssiModel().fit(data), data)
    lower, above = (MapSelection("RSSI", 0, height) for height in view.floors.height_m)
    assert view.floors.names == ("lower", "upper")
    assert view.on_floor(above.height).tolist() == upper.tolist()
    assert view.silent(above).mean() > 0.9 > 0.1 > view.silent(lower).mean()
    assert ("Hatched" in view.coloured(above).sentence, "Hatched" in view.coloured(lower).sentence) == (True, False)
    floor = RssiView("one floor measured", view.model, data.subset(~upper))
    assert (floor.known(above.height).any(), floor.known(lower.height).any()) == (False, True)
    assert sum(floor.best(above.height).values()) == pytest.approx(1)
    assert "No cell" in floor.coloured(replace(above, kind="coverage")).sentence
    assert np.nanmean(charts.stripes(view.silent(above))) == 1


@pytest.fixture(scope="module")
def located_floor():
    """A locator on the built-in floor, its data, and which rows it was fitted to."""
    data = rssi_room(n=80)
    train, _ = data.split()
    return RssiLocator(n_cells=300).fit(train), data, torch.isin(data.index, train.index)


@pytest.fixture(autouse=True)
def few_positions(monkeypatch):
    """Fewer positions on maps of expected errors, each of which takes many located rows."""
    monkeypatch.setattr("tasks.view.locating.N_POSITIONS", 40)


@pytest.fixture
def locating(located_floor):
    return RssiLocating(*located_floor)


def test_posterior_of_a_row_is_that_of_the_locator(locating, located_floor):
    locator, data, in_training = located_floor
    assert not in_training[locating.first]
    row = locating.nearest(*data.transmitter_position[7, :2].tolist())
    assert row == 7 == locating.numbered(7.2)
    found, posterior = locating.located(row), locator.locate(data.rssi_dbm[7:8])
    np.testing.assert_allclose(found.median, posterior.median[0])
    assert found.radius == (float(posterior.credible_radius(0.5)), float(posterior.credible_radius(0.8)))
    assert found.error_m == pytest.approx(float((posterior.median[0] - data.transmitter_position[7]).norm()))
    assert np.nanmax(found.density.values) == 1
    assert found.density.at(*posterior.most_likely[0, :2].tolist()) == pytest.approx(1)
    part = "training" if in_training[7] else "test"
    assert f"{part} row 7: median at {found.median[0]:.2f}" in locating.describe(row)
    assert spectra.angle_between((30.0, 20.0), (210.0, 80.0)) == pytest.approx(80)


def test_rows_are_simulated_from_the_distributions_of_the_locator(located_floor, generator):
    locator, data, _ = located_floor
    at = data.transmitter_position[:3]
    rssi = locator.sample(at, 4000, generator)
    assert not rssi.isnan().all(dim=2).any()
    predicted = locator.model.predict(at)
    median = rssi.nanmedian(dim=0).values
    often = rssi.isnan().double().mean(dim=0) < 0.5
    # losses do not depend on the noise, so that they leave the median alone
    assert float(((median - predicted.mean) / predicted.std)[often].abs().max()) < 0.1


def test_expected_error_is_that_of_the_test_rows(locating, located_floor):
    locator, data, in_training = located_floor
    values = locating.expected_error.values[np.isfinite(locating.expected_error.values)]
    assert f"{values.mean():.1f} m on average, 90 % below {np.quantile(values, 0.9):.1f} m" in locating.summary
    test = data.subset(~in_training)
    error = (locator.locate(test.rssi_dbm).median - test.transmitter_position).norm(dim=1).mean()
    expected = locating.expected_error
    inside = np.isfinite(expected.values)
    assert 20 <= inside.sum() <= 80
    assert expected.values[inside].mean() == pytest.approx(float(error), rel=0.5)
    assert np.isnan(expected.at(1e3, 0))
    again = RssiLocating(*located_floor).expected_error
    np.testing.assert_array_equal(expected.values, again.values)


def test_larger_errors_of_rssi_make_the_expected_error_larger(located_floor):
    """Here RSSI deviates three times as far from the maps."""
    locator, data, in_training = located_floor
    noisy = copy.copy(locator)
    values = locator.likelihoods.values
    noisy.likelihoods = replace(locator.likelihoods, values=replace(values, scale=9 * values.scale))
    expected = [np.nanmean(RssiLocating(one, data, in_training).expected_error.values) for one in (locator, noisy)]
    assert expected[1] > 1.3 * expected[0]


def test_view_of_a_locator_by_itself(located_floor, tmp_path):
    locator, data, in_training = located_floor
    locator.save(tmp_path / "locator.safetensors")
    view = open_source(tmp_path / "locator.safetensors")
    assert view.kinds[-2:] == ("posterior", "expected error")
    train = data.subset(in_training)
    np.testing.assert_allclose(view.rows.rssi_dbm, train.rssi_dbm, atol=1e-4)
    assert view.locating.in_training.all()
    selection = MapSelection("posterior", 0, 1.2, row=3)
    coloured = view.coloured(selection)
    assert coloured.values.shape == view.locating.located(3).density.values.shape
    assert coloured.corners == view.locating.located(3).density.corners
    assert list(pd.read_csv(io.StringIO(view.table(selection)))) == ["x_m", "y_m", "posterior_of_row_3"]
    assert "of its maximum" in view.describe(selection, *train.transmitter_position[3, :2].tolist())
    assert "outside the region" in view.describe(selection, 1e3, 1e3)


def test_view_of_a_run_of_locate(located_floor, tmp_path):
    locator, data, in_training = located_floor
    table = data.to_frame()
    table.to_csv(tmp_path / "survey.csv", index=False)
    folder = tmp_path / "run"
    folder.mkdir()
    locator.save(folder / "locator.safetensors")
    read = load_rssi(tmp_path / "survey.csv")
    config = {"task": "locate", "config": by_name(LocateConfig(data=str(tmp_path / "survey.csv")))}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "environment.json").write_text(json.dumps({"input_sha256": dict(read.source)}))
    view = open_source(folder)
    assert not view.notes
    np.testing.assert_array_equal(view.locating.in_training, in_training)
    np.testing.assert_allclose(view.position, data.transmitter_position)
    (tmp_path / "survey.csv").write_text("changed")
    assert open_source(folder).locating.in_training.all()


def test_posterior_of_a_spectrum_is_that_of_the_locator(aoa_run, room, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(aoa_run, folder)
    with small.known_planes(small.FLOOR):
        locator = MatchedField(max_cells=200, n_best=20, n_background=10, n_rounds=1).fit(room)
    locator.save(folder / "matched_field-mix1.safetensors")
    view = open_source(folder)
    assert view.models[0].locator_file is None
    found, posterior = view.located(view.models[1], 3), locator.locate(view.data.store[3:4])
    np.testing.assert_allclose(found.median, posterior.median[0], atol=1e-3)
    np.testing.assert_allclose(found.truth, room.position[3], atol=1e-6)
    x0, x1, y0, y1 = found.density.corners
    low, high = posterior.position[0].amin(dim=0), posterior.position[0].amax(dim=0)
    assert x0 <= low[0] <= high[0] <= x1
    assert y0 <= low[1] <= high[1] <= y1
    assert np.nanmax(found.density.values) == 1
    shutil.copy(folder / "swiftwrf-mix1.safetensors", folder / "matched_field-mix1.safetensors")
    with pytest.raises(InputError, match="expected a matched-field locator"):
        open_source(folder).models[1].locator  # noqa: B018


def said(capsys, *arguments) -> str:
    assert quick.command("view", *arguments) == 2
    return quick.said(capsys)


@needs_the_extra
def test_refusals(tmp_path, capsys, aoa_run, rssi_run):
    assert "does not exist" in said(capsys, tmp_path / "nowhere", "--port", 0)
    assert "is no run" in said(capsys, tmp_path, "--port", 0)
    assert "cannot be read" in said(capsys, "x" * 300, "--port", 0)
    (tmp_path / "text").write_text("x")
    assert "safetensors" in said(capsys, tmp_path / "text", "--port", 0)
    for source, names in ((aoa_run, "*mix*"), (rssi_run, "model.safetensors")):
        bare = tmp_path / source.parent.name
        shutil.copytree(source, bare)
        for file in bare.glob(names):
            file.unlink()
        assert "holds no model" in said(capsys, bare, "--port", 0)
    (bare / "config.json").write_text('{"task": "inspect"}')
    assert "tasks.inspect" in said(capsys, bare, "--port", 0)
    kinds.save("nerf2 rssi model", tmp_path)
    assert "cannot be shown" in said(capsys, tmp_path / "model", "--port", 0)


@needs_the_extra
def test_addresses_that_cannot_be_listened_on(capsys, rssi_run):
    assert "--port must be" in said(capsys, rssi_run, "--port", 70000)
    assert "--host" in said(capsys, rssi_run, "--host", "203.0.113.1")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert "is in use" in said(capsys, rssi_run, "--port", taken.getsockname()[1])


def test_without_the_extra(capsys, monkeypatch, rssi_run):
    for name in [name for name in sys.modules if name.startswith("tasks.view.") and name.endswith(("server", "page"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "nicegui", None)
    assert "pip install 'swiftwrf-tasks[view]'" in said(capsys, rssi_run)


def test_a_dropped_floor_plan_lies_at_its_scale_and_origin_and_stays(rssi_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(rssi_run, folder)
    view = open_source(folder)
    before = view.known(1.0).shape
    pixels = np.full((30, 80, 3), 9, dtype=np.uint8)
    view.place(FloorPlan.scaled(pixels, 0.5, (4, 26)))  # y counts down from the upper edge
    assert view.plan.corners == (-2, 38, -2, 13)
    assert view.map(1.0).corners[1] == pytest.approx(38)
    assert view.known(1.0).shape == view.map(1.0).mean.shape[1:] != before
    again = open_source(folder).plan
    assert again.corners == (-2, 38, -2, 13)
    np.testing.assert_array_equal(again.pixels, pixels)
    for scale, origin in ((0.0, (0, 0)), (np.nan, (0, 0)), (1.0, (np.inf, 0)), (1e308, (1, 1)), (1.0, (1e300, 0))):
        with pytest.raises(InputError, match="scale"):
            FloorPlan.scaled(pixels, scale, origin)


def test_a_followed_run_is_read_again_when_it_grows(tmp_path):
    data = rssi_room(n=70)
    follower, record = Follower(RssiModel().fit(data.subset(torch.arange(60)))), Record("source", "dB")
    (tmp_path / "config.json").write_text(json.dumps({"task": "update"}))
    with pytest.raises(InputError, match="no record"):
        open_source(tmp_path)
    record.write(tmp_path)
    view = open_source(tmp_path)
    assert "0 measurements" in snapshot(view, view.version)[0].sentences()[0]
    for i in range(60, 63):
        step = follower.step(data.subset(torch.tensor([i])))
        record.append(tmp_path, record.add(i, replace(step, alarms=("hall weaker everywhere",)) if i == 62 else step))
    version = view.version
    shown = snapshot(view, version)
    assert snapshot(view, view.version) is shown
    assert [row["index"] for row in shown[0].rows] == [60, 61, 62]
    assert shown[0].rows[-1]["alarm"] == "hall weaker everywhere"
    assert "Change at measurement 62: hall weaker everywhere." in shown[0].sentences()
    assert all(figure.startswith("<svg") for figure in shown[1].values())
    record.append(tmp_path, record.add(63, step))
    assert view.version != version
    assert "4 measurements" in snapshot(view, view.version)[0].sentences()[0]


def test_positions_outside_of_the_measured_ones_are_extrapolated(aoa_run):
    view = open_source(aoa_run)
    middle = view.positions.mean(axis=0)
    assert not view.extrapolates(middle)
    assert view.extrapolates(view.positions.max(axis=0) + 1)


@needs_the_extra
@pytest.mark.parametrize("length", [True, False])
def test_large_uploads_are_refused_by_the_server(length):
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import Route
    from starlette.testclient import TestClient

    from tasks.view.page import MAX_UPLOAD_BYTES, limited

    async def upload(request: Request) -> Response:
        return Response(str(len(await request.body())))

    app = Starlette(routes=[Route("/", upload, methods=["POST"])])
    app.add_middleware(limited)
    for n, code in ((MAX_UPLOAD_BYTES, 200), (MAX_UPLOAD_BYTES + 2**20, 413)):
        body = bytes(n)
        content = body if length else iter([body[: n // 2], body[n // 2 :]])
        assert TestClient(app).post("/", content=content).status_code == code


@needs_the_extra
def test_requests_are_answered_one_by_one_and_the_newest_last(monkeypatch):
    from tasks.view import page

    monkeypatch.setattr(page.background_tasks, "create", asyncio.ensure_future)
    events, asked = [], []

    async def answer(number):
        events.append(("begin", number))
        await asyncio.sleep(0.01)
        events.append(("end", number))
        raise ValueError(number)  # does not keep the newest from being answered

    async def ask():
        queue = page.NewestOnly(answer)
        for pause in (None, 0.002, 0.002, None, 0.002, 0.1):
            queue.submit(len(asked))
            asked.append(pause)
            if pause:
                await asyncio.sleep(pause)

    asyncio.run(ask())
    assert [kind for kind, _ in events] == ["begin", "end"] * (len(events) // 2)
    assert events[-1] == ("end", 5)


@needs_the_extra
@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "::1", "localhost"])
def test_addresses_of_this_machine_answer_to_their_own_names(host):
    from tasks.view.page import local_names

    assert {"localhost", f"[{host}]" if ":" in host else host} <= set(local_names(host))
    assert not local_names("0.0.0.0")


def test_models_of_pairs_are_refused_with_what_they_can(tmp_path):
    data = rssi_room(n=30)
    PairModel().fit(data).save(tmp_path / "model.safetensors")
    for act in (open_source, saved_model):
        with pytest.raises(InputError, match=r"rssi pair model.*report of its run"):
            act(tmp_path / "model.safetensors")
