"""Tables in compressed files and databases are those of the plain text."""

import gzip
import sqlite3
import sys
import zipfile

import numpy as np
import pandas as pd
import pytest

import swiftwrf
from swiftwrf.errors import InputError

PLAIN = "x,y,a,b\n0,0,-50,-60\n1,0,-51,-61\n0,2,-52,-62\n3,3,-53,-63\n4,1,-54,-64\n"


@pytest.fixture
def plain(tmp_path):
    file = tmp_path / "plain.csv"
    file.write_text(PLAIN)
    return swiftwrf.load_rssi(file)


def test_gzip(tmp_path, plain):
    (tmp_path / "in").mkdir()
    with gzip.open(tmp_path / "in" / "walk.csv.gz", "wt") as stream:
        stream.write(PLAIN)
    for source in (tmp_path / "in" / "walk.csv.gz", tmp_path / "in"):
        read = swiftwrf.load_rssi(source)
        assert read.name == "walk"
        assert read.rssi_dbm.equal(plain.rssi_dbm)
        assert read.transmitter_position.equal(plain.transmitter_position)


def test_zip(tmp_path, plain):
    with zipfile.ZipFile(tmp_path / "walk.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("export/walk.csv", PLAIN)
        archive.writestr("export/readme.txt", "of Monday")
        archive.writestr("__MACOSX/export/._walk.csv", "\0")
    assert swiftwrf.load_rssi(tmp_path / "walk.zip").rssi_dbm.equal(plain.rssi_dbm)


def test_broken(tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "two.zip", "w") as archive:
        archive.writestr("a.csv", PLAIN)
        archive.writestr("b.csv", PLAIN)
    (tmp_path / "cut.csv.gz").write_bytes(gzip.compress(PLAIN.encode())[:-12])
    (tmp_path / "none.zip").write_bytes(b"PK")
    (tmp_path / "book.xlsx").write_bytes(b"PK")
    (tmp_path / "no.sqlite").write_bytes(b"SQLite")
    expected = {
        "two.zip": "unpack it and name the one",
        "cut.csv.gz": "not a gzip file",
        "none.zip": "not a zip archive",
        "book.xlsx": "is not a workbook|save the sheet as CSV",
        "no.sqlite": "not a SQLite database",
    }
    for name, words in expected.items():
        with pytest.raises(InputError, match=words):
            swiftwrf.load_rssi(tmp_path / name)
    monkeypatch.setattr("swiftwrf.data.files.MAX_TEXT_BYTES", 10_000)
    (tmp_path / "bomb.csv.gz").write_bytes(gzip.compress(PLAIN.encode() + b"5,5,-60,-70\n" * 10_000))
    with pytest.raises(InputError, match="unpacks to more than"):
        swiftwrf.load_rssi(tmp_path / "bomb.csv.gz")


def test_a_workbook_has_the_table_of_its_only_sheet_with_values(tmp_path, plain):
    openpyxl = pytest.importorskip("openpyxl", reason="needs the extra xlsx")
    book = openpyxl.Workbook()
    book.create_sheet("notes")
    for number, line in enumerate(PLAIN.split()):
        book.active.append([float(cell) if number else cell for cell in line.split(",")])
    book.save(tmp_path / "walk.xlsx")
    read = swiftwrf.load_rssi(tmp_path / "walk.xlsx")
    assert read.rssi_dbm.equal(plain.rssi_dbm)
    assert read.transmitter_position.equal(plain.transmitter_position)
    book["notes"]["A1"] = "of Monday"
    book.save(tmp_path / "two.xlsx")
    with pytest.raises(InputError, match="2 of its sheets have values"):
        swiftwrf.load_rssi(tmp_path / "two.xlsx")


def test_a_workbook_without_openpyxl_is_refused_with_both_remedies(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    (tmp_path / "walk.xlsx").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"save the sheet as CSV.*swiftwrf-tasks\[xlsx\]"):
        swiftwrf.load_rssi(tmp_path)


def rows_of_walk():
    rows = []
    for place in range(12):
        latitude, longitude = 48.1 + 1e-4 * (place // 4), 11.5 + 1e-4 * (place % 4)
        for number, bssid in enumerate(("aa:00:00:00:00:01", "aa:00:00:00:00:02")):
            rows.append((1_700_000_000 + place, bssid, -50.0 - place - 10 * number, latitude, longitude))
    return rows


def check_walk(file):
    read, expected = swiftwrf.load_rssi(file), np.stack([-50.0 - np.arange(12), -60.0 - np.arange(12)], axis=1)
    assert read.receiver_names == ("aa:00:00:00:00:01", "aa:00:00:00:00:02")
    np.testing.assert_array_equal(read.rssi_dbm.numpy(), expected)
    np.testing.assert_allclose(read.time.numpy(), np.arange(12))
    degrees = read.origin.to_degrees(read.transmitter_position.numpy()[:, :2])
    np.testing.assert_allclose(degrees[5], [48.1001, 11.5001], atol=1e-7)


def test_wigle(tmp_path):
    table = pd.DataFrame(rows_of_walk(), columns=["time", "bssid", "level", "lat", "lon"])
    table = table.assign(_id=np.arange(24), time=1000 * table.time, altitude=520.0, accuracy=4.0)
    with sqlite3.connect(tmp_path / "wigle.sqlite") as database:
        table.to_sql("location", database, index=False)
    check_walk(tmp_path / "wigle.sqlite")


@pytest.mark.parametrize("units", [1, 10**5])
def test_kismet(tmp_path, units):
    table = pd.DataFrame(rows_of_walk(), columns=["ts_sec", "transmac", "signal", "lat", "lon"])
    table = table.assign(ts_usec=0, alt=520.0, frequency=2437000.0, lat=table.lat * units, lon=table.lon * units)
    unknown = table.iloc[:1].assign(signal=0.0)
    with sqlite3.connect(tmp_path / "Kismet.kismet") as database:
        pd.concat([table, unknown]).to_sql("packets", database, index=False)
    check_walk(tmp_path / "Kismet.kismet")


def test_another_database(tmp_path):
    with sqlite3.connect(tmp_path / "other.db") as database:
        pd.DataFrame({"a": [1]}).to_sql("orders", database, index=False)
    with pytest.raises(InputError, match=r"export one of its tables as CSV \(orders\)"):
        swiftwrf.load_rssi(tmp_path / "other.db")
