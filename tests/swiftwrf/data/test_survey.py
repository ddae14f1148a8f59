"""Survey tables: long, wide, their sentinels and names, and what is refused."""

import numpy as np
import pandas as pd
import pytest
import torch
from samples import survey_rows, write_survey

from swiftwrf import InputError, load_rssi
from swiftwrf.data.coordinates import PlanFrame
from swiftwrf.data.receivers import read_places

NAMES, ROWS = survey_rows()
WIDE = pd.DataFrame(ROWS, columns=NAMES)
NOT_HEARD = WIDE[NAMES[3:]] == -100


def same(data, table=WIDE, names=tuple(NAMES[3:])):
    """Return True if the data equal the wide table up to the order of rows and receivers."""
    columns = [data.receiver_names.index(name) for name in names]
    read = torch.cat([data.transmitter_position, data.rssi_dbm[:, columns]], dim=1).nan_to_num(-100)
    expected = torch.tensor(table[["x", "y", "z", *names]].to_numpy())
    order = [t[:, 0].argsort() for t in (read, expected)]
    return torch.allclose(read[order[0]], expected[order[1]], atol=1e-9)


def test_wide_table(tmp_path):
    data = load_rssi(write_survey(tmp_path))
    assert data.receiver_names == tuple(NAMES[3:])
    assert same(data)
    assert not data.located
    assert data.name == "walk"
    assert data.notes == (
        f"taken as: x = x, y = y, z = z, RSSI of 3 receivers = {', '.join(NAMES[3:])}",
        f"-100 counts as not detected: {NOT_HEARD.sum().sum()} of 120 cells ({NOT_HEARD.to_numpy().mean():.0%})",
    )


def test_parquet(tmp_path):
    WIDE.mask(WIDE == -100).to_parquet(tmp_path / "walk.parquet")
    assert same(load_rssi(tmp_path / "walk.parquet"))
    assert same(load_rssi(tmp_path))


def test_long_parquet_may_lack_times_and_not_receivers(tmp_path):
    times = [*pd.date_range("2026-01-01", periods=11, freq="s"), pd.NaT]
    table = pd.DataFrame({"x": range(12), "y": 1.0, "z": 1.0, "time": times, "receiver": "a", "rssi": -50.0})
    table.to_parquet(tmp_path / "walk.parquet")
    assert len(load_rssi(tmp_path / "walk.parquet")) == 12
    table.assign(receiver=["a"] * 4 + [None] + ["a"] * 7).to_parquet(tmp_path / "walk.parquet")
    with pytest.raises(InputError, match="row 5 has no receiver"):
        load_rssi(tmp_path / "walk.parquet")


def test_rows_that_equal_an_earlier_one_are_named(tmp_path):
    notes = load_rssi(write_survey(tmp_path, rows=[*ROWS, ROWS[3], ROWS[3]])).notes
    assert f"rows equal an earlier one in all columns and count once more: 2 of {len(ROWS) + 2}" in notes


def test_positions_without_a_known_header_are_refused_with_all_that_are_known(tmp_path):
    (tmp_path / "places.csv").write_text("width,depth\n1,2\n")
    with pytest.raises(InputError, match="no columns of positions, x and y or longitude and latitude; there are width"):
        read_places(tmp_path / "places.csv", None, PlanFrame())


def test_packets_of_one_place_have_a_row_each(tmp_path):
    header = ["x", "y", "Receiver Name", "RSSI [dBm]"]
    rows = [[1, 1, "a", -50], [1, 1, "b", -60], [1, 1, "a", -52], [2, 2, "b", -70]]
    data = load_rssi(write_survey(tmp_path, header=header, rows=rows))
    assert data.rssi_dbm.nan_to_num(0).tolist() == [[-50, -60], [-52, 0], [0, -70]]
    assert data.transmitter_position[:, 0].tolist() == [1, 1, 2]
    assert "no height" in data.notes[1]


def test_semicolons_and_decimal_commas(tmp_path):
    lines = ["Pos X (m);pos_y;Height;gateway 1", "1,5;2;1,25;-50,5", "2,5;3;1,25;-60"]
    (tmp_path / "walk.csv").write_text("\n".join(lines))
    data = load_rssi(tmp_path / "walk.csv")
    assert data.transmitter_position.tolist() == [[1.5, 2, 1.25], [2.5, 3, 1.25]]
    assert data.rssi_dbm[:, 0].tolist() == [-50.5, -60]


def test_uji_indoor_loc(tmp_path):
    columns = ["LONGITUDE", "LATITUDE", "FLOOR", "BUILDINGID", "SPACEID", "USERID", "TIMESTAMP"]
    header = ["WAP001", "WAP002", "WAP003", *columns]
    place = [[-7541.2 + i, 4864921.0 + i, i % 3] for i in range(12)]
    rows = [[-80 + i, 100, 100 if i % 2 else -90, *at, 1, 106, 2, 1371713733] for i, at in enumerate(place)]
    data = load_rssi(write_survey(tmp_path, "trainingData.csv", header, rows))
    assert data.receiver_names == ("WAP001", "WAP003")
    assert data.transmitter_position[2].tolist() == [-7539.2, 4864923.0, 8.0]
    assert data.rssi_dbm[1].isnan().tolist() == [False, True]
    notes = " ".join(data.notes)
    assert "never detected the transmitter are left out: 1" in notes
    assert "BUILDINGID, SPACEID, USERID" in notes
    assert "each floor of column FLOOR counts as 4 m" in notes


def test_columns_named_by_the_user(tmp_path):
    header = ["easting_of_robot", "y", "z", "speed", "ap one", "ap two"]
    rows = [[i, i, 1, -0.5, -50 - i, -60] for i in range(12)]
    file = write_survey(tmp_path, header=header, rows=rows)
    with pytest.raises(InputError, match=r"no column for x.*x=NAME"):
        load_rssi(file)
    data = load_rssi(file, columns={"x": "easting_of_robot", "rssi": "ap *"})
    assert data.receiver_names == ("ap one", "ap two")
    rows = [[i, i, -50, -60] for i in range(12)]
    named = write_survey(tmp_path, "named.csv", header=["x", "y", "a[1]", "a1"], rows=rows)
    assert load_rssi(named, columns={"rssi": "a[1]"}).receiver_names == ("a[1]",)  # before it is taken for a pattern
    with pytest.raises(InputError, match="no column 'nowhere' for y"):
        load_rssi(file, columns={"x": "easting_of_robot", "y": "nowhere"})
    with pytest.raises(
        InputError, match="columns takes x, y, z, longitude, latitude, floor, time, session, receiver, rssi, got 'w'"
    ):
        load_rssi(file, columns={"w": "y"})


def test_weak_values_make_100_a_measured_one(tmp_path):
    rows = [[i, i, 1, -95.0 - i] for i in range(12)]
    data = load_rssi(write_survey(tmp_path, header=["x", "y", "z", "rsrp"], rows=rows))
    assert not data.rssi_dbm.isnan().any()
    assert "counts as measured" in data.notes[1]


def test_positions_of_receivers_beside_the_table(tmp_path):
    file = write_survey(tmp_path)
    lines = ["receiver,x,y,z", *(f"{name},{i},2,3" for i, name in enumerate(reversed(NAMES[3:])))]
    (tmp_path / "receivers.csv").write_text("\n".join(lines))
    data = load_rssi(file)
    assert data.located
    assert data.receiver_position[:, 0].tolist() == [2, 1, 0]
    assert set(data.source) == {"walk.csv", "receivers.csv"}
    (tmp_path / "receivers.csv").write_text("\n".join([*lines, lines[1]]))
    with pytest.raises(InputError, match="must have each receiver once"):
        load_rssi(file)
    (tmp_path / "receivers.csv").write_text("\n".join([lines[0], "elsewhere,1,2,3"]))
    with pytest.raises(InputError, match="has none of the receivers"):
        load_rssi(file)


def test_one_row_without_a_fix_has_no_height(tmp_path):
    near = [[0.3 + 0.5 * i, 0.3 + 0.2 * i, 1.2, -50.0 - i] for i in range(12)]
    data = load_rssi(write_survey(tmp_path, header=["x", "y", "z", "a"], rows=[*near, [0, 0, 0, -60]]))
    assert len(data) == 12
    floor = [[x, y, 0, rssi] for x, y, _, rssi in near]
    assert len(load_rssi(write_survey(tmp_path, header=["x", "y", "z", "a"], rows=[*floor, [0, 0, 0, -60]]))) == 13


def test_a_filler_of_receivers_some_of_which_detect_every_row(tmp_path):
    draw = np.random.default_rng(0)
    weak = np.maximum(draw.normal(-92, 8, (80, 4)).round(), -92)
    table = pd.DataFrame(np.hstack([draw.uniform(0, 9, (80, 2)), weak, draw.normal(-50, 8, (80, 2)).round()]))
    header = ["x", "y", "a", "b", "c", "d", "near", "nearer"]
    data = load_rssi(write_survey(tmp_path, header=header, rows=table.to_numpy().tolist()))
    assert "-92 counts as not detected" in " ".join(data.notes)


def _table(header, *rows):
    return lambda folder: write_survey(folder, header=header.split(","), rows=[row.split(",") for row in rows])


REFUSED = {
    "no positions": (_table("a,b", "-50,-60"), "no column for x"),
    "no RSSI": (_table("x,y,speed", "1,2,3"), "no column of RSSI"),
    "positive RSSI": (_table("x,y,a", "1,2,45", "1,2,90"), "numbers below 0"),
    "receiver without RSSI": (_table("x,y,receiver", "1,2,a"), "no RSSI beside"),
    "two columns for x": (_table("x,pos_x,y,a", "1,1,2,-50"), "may be x"),
    "degrees or metres": (_table("lon,lat,a", "11.5,48.1,-50", "17.5,40.1,-50"), "--coordinates metres"),
    "latitude beyond 90": (_table("lat,lon,a", "111.5,48.1,-50"), "are they swapped"),
    "text as position": (_table("x,y,a", "here,2,-50"), "'here' is not a number"),
    "text as RSSI": (_table("x,y,a", "1,2,-50", "1,2,-51", "1,2,loud"), "'loud' is not a number"),
    "no position": (_table("x,y,a", ",2,-50", "1,,-50"), "without a position are left out: 2 of 2"),
    "far position": (_table("x,y,a", "1e12,2,-50"), "at most 1e"),
    "too strong": (_table("x,y,a", "1,2,-50", "1,2,-50", "1,2,31"), "row 3, receiver a: 31 dBm"),
    "too strong, long": (
        _table("x,y,receiver,rssi", "1,2,a,-50", "1,2,b,-50", "2,2,a,31"),
        "row 3, receiver a: 31 dBm",
    ),
    "no receiver": (_table("x,y,receiver,rssi", "1,2,a,-50", "1,2,,-50"), "row 2 has no receiver in column receiver"),
    "never heard": (_table("x,y,a", "1,2,-100"), "no RSSI that a receiver detected"),
    "ragged": (lambda f: write_survey(f) and (f / "walk.csv").write_text("x,y,a\n1,2\n"), "has 2 values"),
    "no rows": (lambda f: write_survey(f) and (f / "walk.csv").write_text("x,y,a\n"), "no rows"),
    "two tables": (lambda f: (write_survey(f), write_survey(f, "b.csv")), "2 tables"),
    "a name twice": (_table("x,y,a,a", "1,2,-50,-60"), "'a' twice"),
    "no Parquet": (lambda f: (f / "walk.parquet").write_bytes(b"PAR1"), "not a Parquet file"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refuses(tmp_path, name):
    make, says = REFUSED[name]
    make(tmp_path)
    with pytest.raises(InputError, match=says):
        load_rssi(tmp_path)
