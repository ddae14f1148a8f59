"""tasks.convert: what it reads, records and calibrates. That data come back as they were is in test_round_trips."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import quick
import torch
from samples import snapshots, walk, write_deepmimo, write_dichasus, write_snapshots
from test_calibration import spoilt, spoilt_in

from swiftwrf import AngularGrid, load_rssi, load_spectra
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data import ReadOptions
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS
from swiftwrf.metrics import angle_errors

GRID = ("--grid", 24, 96)


def run(*arguments):
    return quick.run("convert", *arguments)


def test_a_conversion_records_its_source_and_reads_it_as_asked(tmp_path, capsys):
    write_dichasus(tmp_path / "source")
    assert run(tmp_path / "source", tmp_path / "own", *GRID, "--station", 1) == 0
    before = load_spectra(tmp_path / "source", grid=AngularGrid.hemisphere(24, 96), station=1)
    assert torch.equal(load_spectra(tmp_path / "own").spectrum, before.spectrum)
    record = json.loads((tmp_path / "own" / "conversion.json").read_text())
    assert record["source_sha256"] == before.source
    assert record["notes"] == list(before.notes)
    walk().assign(phone=["old", "new", "other"] * 20).to_csv(tmp_path / "walk.csv", index=False)
    assert run(tmp_path / "walk.csv", tmp_path / "phones", "--offset-by", "phone=new") == 0
    assert load_rssi(tmp_path / "phones").groups.name == "phone"
    assert run(tmp_path / "walk.csv", tmp_path / "without") == 0
    assert "rows differ in phone" in capsys.readouterr().err
    assert load_rssi(tmp_path / "without").labels == ("phone",)


@pytest.mark.parametrize(
    ("asked", "array"),
    [
        ((4, 0.06, 2.4e9), PlanarArray.square(4, 2.4e9, 0.06)),
        ((4, 4, 0.06, 2.4e9), PlanarArray.square(4, 2.4e9, 0.06)),
        ((2, 8, 0.06, 2.4e9), PlanarArray.grid(2, 8, 0.06, 2.4e9)),
        ((1, 8, 0.06, 2.4e9), PlanarArray.grid(1, 8, 0.06, 2.4e9)),
    ],
)
def test_an_array_of_any_rows_and_columns(tmp_path, asked, array):
    write_deepmimo(tmp_path / "source")
    assert run(tmp_path / "source", tmp_path / "own", *GRID, "--array", *asked) == 0
    expected = load_spectra(tmp_path / "source", array=array, grid=AngularGrid.hemisphere(24, 96))
    assert torch.equal(load_spectra(tmp_path / "own").spectrum, expected.spectrum)


def test_calibration_sees_the_training_part_alone(tmp_path, capsys):
    data, *_ = spoilt(snapshots(n=150))
    folder = write_snapshots(tmp_path / "source", data=data)
    assert run(folder, tmp_path / "own", *GRID, "--calibrate", "--split", "block", "--seed", 1) == 0
    record = json.loads((tmp_path / "own" / "conversion.json").read_text())["calibration"]
    assert np.linalg.norm(record["turn_deg"]) == pytest.approx(20, abs=1.5)
    (printed,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("calibrated on")]
    degrees = max(record["phase_std_deg"]), np.linalg.norm(record["turn_deg"]), max(record["turn_std_deg"])
    shares = (100 * record[f"line_of_sight_share_{name}"] for name in ("after", "before"))
    expected = (record["clear_positions"], *(round(x, 1) for x in degrees), *map(round, shares))
    assert tuple(map(float, re.findall(r"\d+(?:\.\d+)?", printed))) == expected
    mended = load_spectra(tmp_path / "own")
    usual = snapshots(n=150).spectra(AngularGrid.hemisphere(24, 96))
    assert float((mended.spectrum - usual.spectrum).abs().mean()) < 0.01
    assert float(angle_errors(mended.label, usual.label)["great_circle"].rad2deg().max()) < 2
    assert {name: (len(a), len(b)) for name, (a, b) in mended.named_splits.items()} == {"block": (120, 30)}
    assert torch.equal(mended.split("block")[1].index, data.split("block", 1)[1].index)


@pytest.mark.parametrize(
    ("parts", "says"),
    [
        (["phases"], "training positions: phases to"),
        (["orientation", "position"], r"rotated by 12\.\d deg .*, moved by 0\.3\d m"),
    ],
)
def test_calibration_of_some_parts(tmp_path, capsys, parts, says):
    data, _, turn, shift = spoilt_in(parts, snapshots(n=150))
    folder = write_snapshots(tmp_path / "source", data=data)
    assert run(folder, tmp_path / "own", *GRID, "--calibrate", *parts) == 0
    record = json.loads((tmp_path / "own" / "conversion.json").read_text())
    assert record["options"]["calibrate"] == parts
    assert record["calibration"]["shift_m"] == pytest.approx(shift.tolist(), abs=0.02)
    assert record["calibration"]["turn_deg"] == pytest.approx(turn.rad2deg().tolist(), abs=1)
    assert re.search(says, " ".join(capsys.readouterr().err.split()))
    pose = load_spectra(tmp_path / "own").fixed_position
    assert pose.allclose(snapshots().fixed_position, atol=0.02)


def test_every_format_is_described():
    text = (Path(__file__).parents[2] / "docs" / "formats.md").read_text()
    for formats in (SPECTRA_FORMATS, SNAPSHOT_FORMATS, RSSI_FORMATS):
        for name in formats:
            assert f"[{name}](#" in text, f"describe {name} in docs/formats.md"
    for option in ReadOptions.__dataclass_fields__:
        assert re.search(f"`--{option.replace('_', '-')}[ `]", text), f"describe --{option} in docs/formats.md"
