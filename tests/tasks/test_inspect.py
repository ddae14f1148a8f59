"""tasks.inspect on valid measurements: findings and page. Wrong ones are in test_wrong_conventions.py."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import quick
import torch
from samples import WAVELENGTH, snapshots, write_snapshots, write_survey
from scipy.spatial.distance import cdist
from test_rssi_model import path_loss_only

from swiftwrf import AngularGrid, rssi_room, simulated_room
from swiftwrf.contrib.diagnostics.inspection import Findings, inspect
from swiftwrf.data.formats import SNAPSHOT_FORMATS
from swiftwrf.data.writing import write_spectra
from tasks.configs import AoaConfig, InspectConfig
from tasks.inspect import page
from tasks.options import ReadingOptions
from tasks.source import reading


def run(*arguments):
    return quick.run("inspect", *arguments)


def test_snapshots(tmp_path, capsys):
    write_snapshots(tmp_path / "source")
    assert run(tmp_path / "source", "--grid", 24, 96, "--out", tmp_path / "page") == 0
    text = capsys.readouterr().out
    content = json.loads(
        (tmp_path / "page" / "inspect.json").read_text(), parse_constant=lambda name: pytest.fail(name)
    )
    numbers = content["numbers"]
    assert content["kind"] == "array snapshots"
    assert (numbers["n"], numbers["elements"], numbers["frame"]) == (120, 16, "fits")
    assert numbers["spacing_wavelengths"] == pytest.approx(0.5)
    assert numbers["peak_to_line_of_sight_deg"] < 3
    assert numbers["nearest_wavelengths"] == pytest.approx(numbers["nearest_m"] / WAVELENGTH)
    assert text.startswith(f"{tmp_path / 'source'}: array snapshots. 1 warning: correct the data first.")
    assert "! The nearest other position" in text
    assert "predict between them. They find few walls, if any; measure more densely." in text
    assert "needs no calibration" in text
    html = (tmp_path / "page" / "report.html").read_text()
    assert html.count("<figcaption>") == 3
    assert (tmp_path / "source" / "reading.yaml").read_text() == "grid:\n- 24\n- 96\n"
    assert quick.run("convert", tmp_path / "source", tmp_path / "own") == 0  # reads the files in the same way
    assert "120 spectra of 24 x 96 pixels" in capsys.readouterr().out
    assert all(finding["text"][:20] in html for finding in content["findings"])


def test_options_of_reading_come_from_the_command_line_or_read_or_the_file_beside_the_data(tmp_path):
    write_snapshots(tmp_path / "source")
    (tmp_path / "source" / "reading.yaml").write_text("every: 2")
    (tmp_path / "other.yaml").write_text("every: 3\ndrop_elements: [0]")
    told = [
        (AoaConfig(measured=(0.5,)), 60, "source/reading.yaml states: every 2"),
        (AoaConfig(measured=(0.5,), read=str(tmp_path / "other.yaml")), 40, "states: every 3, drop_elements [0]"),
        (InspectConfig("source", reading=ReadingOptions(every=4)), 30, ""),
    ]
    for config, n, note in told:
        data = reading(config, str(tmp_path / "source")).read(SNAPSHOT_FORMATS)
        assert (len(data), "reading.yaml" in data.source) == (n, bool(note))
        assert note in data.notes[-1] if note else not any("states" in one for one in data.notes)


def test_options_of_reading_that_cannot_be_written_beside_the_data_are_in_the_folder_of_the_page(tmp_path, capsys):
    write_snapshots(tmp_path / "source")
    (tmp_path / "source" / "reading.yaml").mkdir()
    assert run(tmp_path / "source", "--every", 40, "--out", tmp_path / "page") == 0
    assert (tmp_path / "page" / "reading.yaml").read_text() == "every: 40\n"
    assert f"--read {tmp_path / 'page' / 'reading.yaml'}" in (tmp_path / "page" / "report.html").read_text()


def test_a_single_position(tmp_path, capsys):
    write_snapshots(tmp_path / "source", data=snapshots(n=1))
    assert run(tmp_path / "source", "--grid", 24, 96, "--out", tmp_path / "page") == 0
    text = capsys.readouterr().out
    assert "1 positions" in text
    assert "inf m away" not in text


def test_survey(tmp_path, capsys):
    assert run(write_survey(tmp_path / "walk"), "--out", tmp_path / "page") == 0
    text = capsys.readouterr().out
    first, *_, step, report = text.splitlines()
    assert first.endswith(
        "walk.csv: RSSI. Nothing looks wrong. Errors that the files alone do not reveal remain possible."
    )
    assert step == f"Go on: swiftwrf rssi {tmp_path / 'walk' / 'walk.csv'}"
    assert report == f"report: {tmp_path / 'page' / 'report.html'}"
    assert "60 rows of RSSI at 4 receivers" in text
    assert "positions are unknown" in text
    assert (tmp_path / "page" / "report.html").read_text().count("<svg") == 1


def test_positions_that_repeat(tmp_path, capsys):
    room = simulated_room(n=15, grid=AngularGrid.hemisphere(8, 32))
    (tmp_path / "source").mkdir()
    write_spectra(room.subset(torch.arange(15).repeat(2)), tmp_path / "source")
    assert run(tmp_path / "source", "--out", tmp_path / "page") == 0
    said = capsys.readouterr().out
    assert "30 rows are at 15 places" in said
    assert "other position is 0.000 m" not in said


def test_the_page_of_spectra_has_the_numbers_of_the_data():
    data = simulated_room(n=30, grid=AngularGrid.hemisphere(8, 32))
    shown, position = page(Findings(data), "spectra", InspectConfig("a")), data.position.numpy()
    plan, directions, neighbours = shown.plots
    sides = [float(side) for side in re.findall(r"\d+\.\d+", shown.summary.numbers[-1].value)]
    assert sides == pytest.approx(np.ptp(position, axis=0), abs=0.00501)
    for panel, axes in zip(plan.panels, ([0, 1], [0, 2]), strict=True):
        arrows = panel.axes[0].collections[0]
        assert np.stack([arrows.U, arrows.V]) == pytest.approx(
            0.25 * max(sides) * data.rotation.numpy()[axes], rel=0.01
        )
    (azimuth, elevation), (a, e) = data.grid.peak_direction(data.spectrum).T.numpy(), data.label.T.numpy()
    cosine = np.sin(elevation) * np.sin(e) + np.cos(elevation) * np.cos(e) * np.cos(azimuth - a)
    away = np.rad2deg(np.arccos(cosine))[data.line_of_sight.numpy()]
    assert directions.data["peak_from_line_deg"].to_numpy() == pytest.approx(away, abs=1e-3)
    nearest = np.sort(cdist(position, position), axis=1)[:, 1]
    assert neighbours.data["nearest_m"].to_numpy() == pytest.approx(nearest)
    assert neighbours.panels[0].axes[0].lines[0].get_xdata()[0] == pytest.approx(data.array.wavelength / 2)


def test_the_page_of_a_survey_has_the_numbers_of_the_data():
    data = rssi_room(n=30)
    plan, path_loss = page(Findings(data), "RSSI", InspectConfig("a")).plots
    assert plan.data["strongest_dbm"].tolist() == np.nanmax(data.rssi_dbm.numpy(), axis=1).tolist()
    away = cdist(data.transmitter_position.numpy(), data.receiver_position.numpy())[data.detected.numpy()]
    assert path_loss.data["distance_m"].to_numpy() == pytest.approx(away)


def numbers(findings, words):
    """Return the numbers of the only sentence with these words."""
    (text,) = [text for _, text in findings.sentences if words in text]
    return [float(found) for found in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?", text)]


def ranges(position):
    return [end for axis in position.T.tolist() for end in (min(axis), max(axis))]


def test_findings_are_the_numbers_of_snapshots():
    split = {"walk": (torch.arange(45), torch.arange(45, 60))}
    time = torch.arange(60.0) ** 3 / 1000
    data = replace(snapshots(n=60, count=2), line_of_sight=torch.arange(60) < 45, named_splits=split, time=time)
    found, position = inspect(data, grid=(8, 32)), data.position.numpy()
    nearest = np.median(np.sort(cdist(position, position), axis=1)[:, 1])
    for words, expected in (
        ("snapshots of", [60, 2, 16, 0.5, 2.4]),
        ("Taken over", [205.4, np.median(np.diff(time))]),
        ("positions, x", [60, *ranges(position)]),
        ("nearest other", [nearest, nearest / WAVELENGTH]),
        ("have line of sight", [75]),
        ("Split walk", [45, 15]),
    ):
        assert numbers(found, words) == pytest.approx(expected, abs=0.0501), words


def test_findings_are_the_numbers_of_a_survey():
    data = path_loss_only()
    data.rssi_dbm[:9, 0] = torch.nan
    found, detected = inspect(data), data.rssi_dbm[data.detected].numpy()
    extremes = [pytest.approx(end, abs=0.001) for end in (detected.min(), detected.max())]
    assert numbers(found, "rows of RSSI") == [60, 3, 95, *extremes]
    assert numbers(found, "Path-loss models") == [100, -50, 1, 2.0]
