"""A comparison by several stations: its numbers are those of its estimates and the truth."""

import json
from pathlib import Path

import numpy as np
import pytest
from small import Counted

import swiftwrf
from swiftwrf.contrib.comparison.stations import ALONE, StationsComparison, compare_stations
from swiftwrf.locate import MatchedFieldConfig
from swiftwrf.locate.triangulation import peak_directions
from swiftwrf.models.geometry import GeometryModel, Plane
from tasks.view.sources import open_source

QUICK = MatchedFieldConfig(spacing=0.5, max_cells=3000, n_best=60, n_background=20, n_rounds=2)
WALLS = [Plane((-1.0, 0.0, 0.0), 0.0, -0.6), Plane((0.0, 0.0, -1.0), 0.0, -0.6), Plane((0.0, 0.0, 1.0), 3.0, -0.6)]


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("run")


@pytest.fixture(scope="module")
def result(run_folder) -> StationsComparison:
    data = swiftwrf.simulated_stations(n=60, stations=2, grid=swiftwrf.AngularGrid.hemisphere(15, 60))
    part = data.derived(row=data.row.clone())
    part.row[::7, 1] = -1  # the second station did not receive each seventh transmission
    rooms = {name: GeometryModel.of_planes(part.of(name)[1], WALLS) for name in part.names}
    steps = Counted(run_folder)
    result = compare_stations(part, rooms=rooms, config=QUICK, keep=steps)
    assert set(steps.totals) == {len(steps.begun)}, "the number of steps does not grow"
    return result


def test_view_shows_the_room_of_each_station(result, run_folder):
    (run_folder / "config.json").write_text(json.dumps({"task": "locate", "config": {}}), encoding="utf-8")
    view = open_source(run_folder)
    assert [loaded.title for loaded in view.models] == ["at east", "at west"]
    assert all(len(loaded.planes) == len(WALLS) for loaded in view.models)


def test_errors_and_coverage(result):
    estimate = np.array(result.values["posterior"]["estimate"])
    radius = np.array(result.values["posterior"]["radius"])
    error = np.linalg.norm(estimate - result.test.position.numpy(), axis=1)
    entry = result.overall["posterior"]["position_error_m"]
    assert entry["median"] == pytest.approx(np.median(error))
    assert entry["p90"] == pytest.approx(np.quantile(error, 0.9))
    assert result.coverage[0.8] == pytest.approx((error <= radius[:, 1]).mean())
    flat = np.linalg.norm((estimate - result.test.position.numpy())[:, :2], axis=1)
    assert result.overall["posterior"]["horizontal_error_m"]["median"] == pytest.approx(np.median(flat))


def test_directions_at_each_station(result):
    """Angular errors by the dot product of unit vectors, at the transmissions that a station received."""
    table = result.directions.set_index("station")
    peaks = peak_directions(result.test)
    for number, name in enumerate(result.test.names):
        received, spectra = result.test.of(name)
        assert table.loc[name, "received"] == len(received)
        found = np.array(result.values["posterior"]["direction"])[received, number]
        alone = np.array(result.values[ALONE + name]["direction"])[received, 0]
        for column, estimate in (("posterior", found), ("alone", alone), ("peak", peaks[name].numpy())):
            cosine = (_unit(estimate) * _unit(spectra.label.numpy())).sum(axis=1).clip(-1, 1)
            assert table.loc[name, f"{column}_deg"] == pytest.approx(np.median(np.degrees(np.arccos(cosine))), abs=1e-3)


def _unit(angles: np.ndarray) -> np.ndarray:
    azimuth, elevation = angles.T
    return np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )


def test_notes_count_what_was_received(result):
    missed = len(range(0, 60, 7))
    assert result.notes[0] == f"of 60 transmissions, stations received: east {60 - missed}"


def test_answer_and_report(result, tmp_path):
    answer = result.answer()
    assert answer.chosen == "posterior"
    errors = {method.name: method.error["median"] for method in answer.methods}
    assert errors == {name: entry["position_error_m"]["median"] for name, entry in result.overall.items()}
    result.report(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "at 2 stations" in page
    for value in result.directions["posterior_deg"]:
        assert f"{value:.2f}" in page
    assert json.dumps(answer.values())  # as --json prints it


def test_maps_have_the_regions_by_each_station_alone(result):
    maps = result.recorded().arrays["maps"]
    rows = [result.test.index.tolist().index(number) for number in maps["index"]]
    for number, name in enumerate(result.test.names):
        alone = result.values[ALONE + name]
        assert np.array_equal(maps["alone_estimate"][number], np.array(alone["estimate"])[rows])
        assert np.array_equal(maps["alone_radius_80_m"][number], np.array(alone["radius"])[rows, 1])
