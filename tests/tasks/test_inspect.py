"""tasks.inspect on valid measurements: findings and page. Wrong ones are in test_wrong_conventions.py."""

import json

import pytest
import quick
import torch
from samples import WAVELENGTH, snapshots, write_snapshots, write_survey

from swiftwrf import AngularGrid, simulated_room
from swiftwrf.data.writing import write_spectra


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
    assert "! The nearest other position" in text
    assert "interpolators see no fringes" in text
    assert "needs no calibration" in text
    html = (tmp_path / "page" / "report.html").read_text()
    assert html.count("<figcaption>") == 3
    assert "source --grid 24 96" in html  # the next command reads the files in the same way
    assert all(finding["text"][:20] in html for finding in content["findings"])


def test_a_single_position(tmp_path, capsys):
    write_snapshots(tmp_path / "source", data=snapshots(n=1))
    assert run(tmp_path / "source", "--grid", 24, 96, "--out", tmp_path / "page") == 0
    text = capsys.readouterr().out
    assert "1 positions" in text
    assert "inf m away" not in text


def test_survey(tmp_path, capsys):
    assert run(write_survey(tmp_path / "walk"), "--out", tmp_path / "page") == 0
    text = capsys.readouterr().out
    assert "40 rows of RSSI at 3 receivers" in text
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
