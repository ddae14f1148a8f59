"""tasks.convert: what any reader reads comes back as it was from the toolkit's own layout."""

import json
import re
import zipfile
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import quick
import torch
from samples import snapshots, write_deepmimo, write_dichasus, write_espargos, write_snapshots, write_survey
from test_calibration import spoilt, spoilt_in

from swiftwrf import AngularGrid, InputError, load_rssi, load_spectra, simulated_room
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data import ReadOptions
from swiftwrf.data.coordinates import Floors, GeodeticOrigin
from swiftwrf.data.formats import RSSI_FORMATS, SNAPSHOT_FORMATS, SPECTRA_FORMATS
from swiftwrf.data.rssi import SURVEY, Offsets
from swiftwrf.data.writing import write_rssi, write_spectra
from swiftwrf.metrics import angle_errors

GRID = ("--grid", 24, 96)


def run(*arguments):
    return quick.run("convert", *arguments)


SPECTRA = {
    "snapshots": (write_snapshots, {}),
    "HDF5": (lambda folder: write_snapshots(folder, "snapshots.h5"), {}),
    "DeepMIMO": (write_deepmimo, {}),
    "ESPARGOS": (write_espargos, {}),
    "DICHASUS": (write_dichasus, {"station": 1}),
}


@pytest.mark.parametrize("name", SPECTRA)
def test_spectra_come_back_as_they_were(name, tmp_path):
    write, how = SPECTRA[name]
    write(tmp_path / "source")
    options = [x for key, value in how.items() for x in (f"--{key}", value)]
    assert run(tmp_path / "source", tmp_path / "own", *GRID, *options) == 0
    before = load_spectra(tmp_path / "source", grid=AngularGrid.hemisphere(24, 96), **how)
    after = load_spectra(tmp_path / "own")
    for field in ("position", "spectrum", "line_of_sight", "fixed_position"):
        assert torch.equal(getattr(after, field), getattr(before, field)), field
    torch.testing.assert_close(after.label, before.label, rtol=0, atol=1e-12)
    torch.testing.assert_close(after.array.element, before.array.element)
    assert (after.grid, after.moving) == (before.grid, before.moving)
    record = json.loads((tmp_path / "own" / "conversion.json").read_text())
    assert record["source_sha256"] == before.source
    assert record["notes"] == list(before.notes)


def test_rssi_comes_back_as_it_was(tmp_path):
    file = write_survey(tmp_path / "source")
    (tmp_path / "source" / "train_index.txt").write_text("\n".join(map(str, range(30))))
    (tmp_path / "source" / "test_index.txt").write_text("\n".join(map(str, range(30, 40))))
    assert run(file, tmp_path / "own") == 0
    before, after = load_rssi(file), load_rssi(tmp_path / "own")
    assert torch.equal(after.rssi_dbm.nan_to_num(), before.rssi_dbm.nan_to_num())
    assert torch.equal(after.transmitter_position, before.transmitter_position)
    assert after.receiver_names == before.receiver_names
    assert not after.located
    assert torch.equal(after.named_splits["random"][1], before.named_splits["random"][1])


def assert_same(found, data, left_out=()):
    """Every field of the data comes back, those that are added to the class, too."""
    assert type(found) is type(data)
    for field in {field.name for field in fields(data)} - {"name", "source", "notes", *left_out}:
        value, back = getattr(data, field), getattr(found, field)
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(back, value, rtol=0, atol=0, equal_nan=True, msg=field)
        elif isinstance(value, pd.Series):
            pd.testing.assert_series_equal(back, value)
        elif field == "named_splits":
            assert {name: [rows.tolist() for rows in parts] for name, parts in back.items()} == {
                name: [rows.tolist() for rows in parts] for name, parts in value.items()
            }
        else:
            assert back == value, field


def test_what_is_known_of_rssi_comes_back(tmp_path):
    """Also names and values for which the layout has signs."""
    phones = pd.Series((["new", "007", "NA", None] * 10)[:40], name="Phone ID")
    known = {
        "receiver_names": ('a,"b"', "NA", "1"),
        "receiver_position": torch.eye(3, dtype=torch.float64),
        "origin": GeodeticOrigin(48.1234567, -11.5),
        "floors": Floors(("0", "1, 2"), (1.0, 5.25)),
        "receiver_moves": True,
        "session": torch.arange(40) // 20,
        "time": (torch.arange(40).double() / 3).index_fill(0, torch.tensor([7]), torch.nan),
        "groups": phones,
        "offsets": Offsets("Phone ID", "new", {"new": 0.0, "007": -1 / 3, "NA": 2.5}, 0.125),
        "labels": ("Phone ID", "channel: 1"),
        "plan_scale": 20.7,
        "named_splits": {"walk": (torch.arange(30), torch.arange(30, 40))},
    }
    data = replace(load_rssi(write_survey(tmp_path / "a")), **known)
    assert all(getattr(data, field.name) is not None for field in fields(data)), "each field has a value here"
    write_rssi(data, tmp_path)
    back = load_rssi(tmp_path)
    assert_same(back, data)
    assert SURVEY in back.source
    assert quick.run("inspect", tmp_path, "--out", tmp_path / "inspection") == 0
    data.rssi_dbm[0, 0] = -100.0
    write_rssi(data, tmp_path)
    assert load_rssi(tmp_path).rssi_dbm[0, 0] == -99.99
    (tmp_path / "meta.csv").unlink()
    assert load_rssi(tmp_path).groups is None


def test_a_walk_of_several_phones_in_degrees_keeps_them(tmp_path, capsys):
    draw = np.random.default_rng(0)
    table = pd.DataFrame({"latitude": 48 + draw.uniform(0, 2e-4, 60), "longitude": 11 + draw.uniform(0, 2e-4, 60)})
    table = table.assign(z=1.0, phone=["old", "new", "other"] * 20, hall=draw.uniform(-80, -50, 60).round(1))
    table.to_csv(tmp_path / "walk.csv", index=False)
    assert run(tmp_path / "walk.csv", tmp_path / "own", "--offset-by", "phone=new") == 0
    data = load_rssi(tmp_path / "walk.csv", offset_by="phone")
    assert_same(load_rssi(tmp_path / "own"), data)
    assert_same(load_rssi(tmp_path / "own", offset_by="phone"), data)
    with pytest.raises(InputError, match="has groups of phone, not of floor; convert the table again by these"):
        load_rssi(tmp_path / "own", offset_by="floor")
    assert run(tmp_path / "walk.csv", tmp_path / "without") == 0
    assert "rows differ in phone" in capsys.readouterr().err
    assert load_rssi(tmp_path / "without").labels == ("phone",)


@pytest.mark.parametrize("column", ["groups", "time"])
def test_rows_without_a_group_or_time_stay_rows(tmp_path, column):
    """A line without content is no row of a table."""
    value = {
        "groups": pd.Series(["old", None] * 20, name="phone"),
        "time": torch.arange(40.0).where(torch.arange(40) % 2 == 0, torch.nan),
    }[column]
    data = replace(load_rssi(write_survey(tmp_path / "a")), **{column: value})
    write_rssi(data, tmp_path)
    assert_same(load_rssi(tmp_path), data)


def test_what_is_known_of_spectra_comes_back(tmp_path):
    draw = torch.Generator().manual_seed(0)
    room = simulated_room(n=20, grid=AngularGrid.hemisphere(8, 32))
    label = torch.rand(20, 2, generator=draw, dtype=torch.float64).index_fill(0, torch.tensor([3]), torch.nan)
    known = {
        "label": label,
        "line_of_sight": torch.arange(20) % 3 > 0,
        "channel": torch.randn(20, 3, 16, dtype=torch.complex64, generator=draw),
        "frequency_hz": 915e6 + 1e6 * torch.arange(3).double(),
        "named_splits": {"walk": (torch.arange(12), torch.arange(12, 20))},
    }
    data = replace(room, **known)
    assert all(getattr(data, field.name) is not None for field in fields(data)), "each field has a value here"
    write_spectra(data, tmp_path)
    back = load_spectra(tmp_path)
    torch.testing.assert_close(back.rotation, data.rotation)  # by a quaternion
    torch.testing.assert_close(back.array.element, data.array.element)
    assert torch.equal(back.spectrum, data.spectrum)
    assert_same(back, data, left_out=("rotation", "array", "store"))
    write_spectra(room, tmp_path)
    assert "label.npy" not in zipfile.ZipFile(tmp_path / "spectrum.npz").namelist(), "it follows from the positions"


@pytest.mark.parametrize(
    "text",
    [
        "plan_scale: wide",
        "plan_scale: [1, 2]",
        "offsets: 3",
        "offsets: {column: a}",
        "labels: 3",
        "offsets: {column: a, reference: b, explained: nan, offset_db: {b: 0}}",
    ],
)
def test_damaged_properties_of_a_survey_are_refused(tmp_path, text):
    write_rssi(load_rssi(write_survey(tmp_path / "a")), tmp_path)
    (tmp_path / SURVEY).write_text(text)
    with pytest.raises(InputError, match=r"survey\.yml is not a description as convert writes it"):
        load_rssi(tmp_path)


def test_moving_receivers_and_splits_come_back(tmp_path):
    room = simulated_room(n=20, moving="receiver", grid=AngularGrid.hemisphere(8, 32))
    split = {"walk": (torch.arange(12), torch.arange(12, 20))}
    write_spectra(replace(room, named_splits=split), tmp_path)
    back = load_spectra(tmp_path)
    assert back.moving == "receiver"
    assert torch.equal(back.named_splits["walk"][1], split["walk"][1])
    torch.testing.assert_close(back.label, room.label)


def test_an_array_that_the_files_contradict_is_refused(tmp_path):
    write_spectra(simulated_room(n=20, grid=AngularGrid.hemisphere(8, 32)), tmp_path)
    with pytest.raises(InputError, match="another array"):
        load_spectra(tmp_path, array=PlanarArray.square(2, 915e6))
    assert load_spectra(tmp_path, array=PlanarArray.square(4, 915e6)).array == PlanarArray.square(4, 915e6)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda s: s.transpose(0, 2, 1), "transpose"),
        (lambda s: 20 * np.log10(s + 1e-9), "convert decibels"),
        (lambda s: s[:5], "for 20 positions"),
        (lambda s: s * np.nan, "in \\[0, 1\\]"),
        (lambda s: s > 0.5, "got bool"),
    ],
)
def test_arrays_of_something_else_are_refused(tmp_path, change, says):
    room = simulated_room(n=20, grid=AngularGrid.hemisphere(8, 32))
    write_spectra(room, tmp_path)
    np.savez(tmp_path / "spectrum.npz", spectrum=change(room.spectrum.numpy()))
    with pytest.raises(ValueError, match=says):
        load_spectra(tmp_path)


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
