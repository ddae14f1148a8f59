"""Turbo learning at several stations: a run for each, one report, and positions by least squares."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import quick

import swiftwrf
from swiftwrf.data.writing import write_spectra


@pytest.fixture
def folder(tmp_path) -> Path:
    data = swiftwrf.simulated_stations(n=40, stations=2, grid=swiftwrf.AngularGrid.hemisphere(12, 48))
    for name in data.names:
        (tmp_path / "data" / name).mkdir(parents=True)
        write_spectra(data.of(name)[1], tmp_path / "data" / name)
    return tmp_path / "data"


def test_each_station_has_a_run(folder, tmp_path, capsys):
    out, options = tmp_path / "out", ("aoa", "--mix", 0.5, "--data", folder, "--models", "idw")
    assert quick.run(*options, "--out", out) == 0
    said = capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {"east", "west", "report"}
    test = swiftwrf.load_stations(folder).split()[1]
    lines = {}
    for name in test.names:
        metrics = json.loads((out / name / "metrics.json").read_text())
        assert metrics["data"] == f"{name} of data"
        table = pd.read_csv(out / name / "errors.csv")
        chosen = table[table["method"] == metrics["mixes"]["0.5"]["estimator_choice"]["name"]].set_index("index")
        azimuth, elevation = np.deg2rad(
            chosen.loc[test.index, ["estimate_azimuth_deg", "estimate_elevation_deg"]].to_numpy().T
        )
        local = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
        )
        spectra = test.of(name)[1]
        lines[name] = spectra.fixed_position.numpy(), local @ spectra.rotation.numpy().T
    errors = []
    for row, truth in enumerate(test.position.numpy()):
        across = [np.eye(3) - np.outer(unit[row], unit[row]) for _, unit in lines.values()]
        target = sum(part @ at for part, (at, _) in zip(across, lines.values(), strict=True))
        errors.append(np.linalg.norm(np.linalg.solve(sum(across), target) - truth))
    assert f"median {np.median(errors):.2f} m, 90 % below {np.quantile(errors, 0.9):.2f} m (0.5 measured)" in said
    page = (out / "report" / "report.html").read_text(encoding="utf-8")
    assert all(f"{name} of data" in page for name in test.names)


def test_finished_stations_are_kept(folder, tmp_path, capsys):
    out, options = (
        tmp_path / "out",
        ("aoa", "--mix", 0.5, "--data", folder, "--models", "idw", "--out", tmp_path / "out"),
    )
    assert quick.run(*options[:-1], out / "west", "--station", "west") == 0
    before = (out / "west" / "metrics.json").stat().st_mtime_ns
    assert quick.run(*options) == 0
    assert (out / "west" / "metrics.json").stat().st_mtime_ns == before
    assert (out / "report" / "report.html").is_file()
    assert quick.run(*options, "--seed", 1) == 2
    assert "run of other options" in quick.said(capsys)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--station", "north"), "no station 'north'; choose one of east, west"),
        (("--data", "", "--station", "west"), "several arrays"),
    ],
)
def test_refusals(folder, tmp_path, capsys, options, words):
    arguments = () if "--data" in options else ("--data", folder)
    options = [option for option in options if option not in ("--data", "")]
    assert quick.run("aoa", "--mix", 0.5, *arguments, *options, "--out", tmp_path / "run") == 2
    assert words in quick.said(capsys)
