"""The reader of RSSI, and the built-in floor."""

import pytest
import torch
from samples import write_nerf2_rssi

from swiftwrf import InputError, load_rssi, rssi_room

N = 15


@pytest.fixture
def folder(tmp_path):
    """A well-formed folder: three receivers, the third detected only in the last five rows."""
    rows = [f"{-50 - i},{-60 - i},{-70 if i >= N - 5 else -100}" for i in range(N)]
    return write_nerf2_rssi(tmp_path, "a,b,c", "a: [0, 0, 1]\nb: [5, 0, 1]\nc: [0, 5, 1]\n", rows)


def test_reads_and_marks_what_was_not_heard(folder):
    data = load_rssi(folder)
    assert data.receiver_names == ("a", "b", "c")
    assert data.rssi_dbm[0, :2].tolist() == [-50, -60]
    assert data.rssi_dbm.isnan().sum(dim=0).tolist() == [0, 0, 10]
    assert data.receiver_position[1].tolist() == [5, 0, 1]


def test_receivers_by_number_name_and_all(folder):
    data = load_rssi(folder)
    assert data.receivers(["2"]).receiver_names == ("b",)
    assert data.receivers(["b", "1"]).receiver_names == ("b", "a")
    with pytest.raises(InputError, match="there are 1 a, 2 b, 3 c"):
        data.receivers(["4"])
    every = data.receivers(["all"])
    assert every.receiver_names == ("a", "b")
    assert every.notes[-1] == "receivers that detected fewer than 10 rows are left out: c"
    with pytest.raises(InputError, match=r"'c'.*5 rows"):
        data.receivers(["c"])
    with pytest.raises(InputError, match="detected the transmitter in 10 rows"):
        data.columns([2]).receivers(["all"])
    with pytest.raises(InputError, match="once"):
        data.receivers(["a", "1"])


def _write(name, text):
    return lambda folder: (folder / name).write_text(text)


def _rssi(value):
    return _write("gateway_rssi.csv", "a,b,c\n" + f"{value},-60,-70\n" + "-50,-60,-70\n" * (N - 1))


WRONG = {
    "too strong": (_rssi(31), "row 1, receiver a: 31 dBm"),
    "too weak": (_rssi(-151), "row 1, receiver a: -151 dBm"),
    "text": (_rssi("loud"), "row 1, column a: 'loud' is not a number"),
    "short row": (_rssi("-50,-60"), "row 1 has 4 values"),
    "two of one name": (_write("gateway_rssi.csv", "a,a,c\n-1,-2,-3\n"), "'a' twice"),
    "another number of rows": (_write("gateway_rssi.csv", "a,b,c\n-50,-60,-70\n"), "has 1 rows, tx_pos.csv 15"),
    "empty": (_write("gateway_rssi.csv", ""), "is empty"),
    "no receiver with a place": (_write("gateway_position.yml", "d: [0, 0, 1]\n"), "no position of the receivers"),
    "two places of one name": (_write("gateway_position.yml", "a: [0, 0, 1]\na: [1, 1, 1]\n"), "'a' twice"),
    "place of two numbers": (_write("gateway_position.yml", "a: [0, 0]\nb: [1, 1]\nc: [1, 2]\n"), "3 finite numbers"),
    "nan positions": (_write("tx_pos.csv", "x,y,z\n" + "nan,1,1\n" * N), "needs 3 finite numbers"),
    "origin": (_write("survey.yml", "origin: [91, 0]"), "latitude and longitude"),
    "floors": (_write("survey.yml", "floors: {up: 4, down: 1}"), "ascending"),
    "one number of floors": (_write("survey.yml", "floors: 3"), "names with ascending heights"),
    "moving receiver": (_write("survey.yml", "receiver_moves: perhaps"), "true or false"),
    "unknown property": (_write("survey.yml", "storeys: 3"), "states storeys"),
    "index out of range": (
        lambda f: [_write(f"{part}_index.txt", text)(f) for part, text in (("train", "0\n"), ("test", "15\n"))],
        "expected 0 to 14",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_refuses(folder, name):
    spoil, says = WRONG[name]
    spoil(folder)
    with pytest.raises(InputError, match=says):
        load_rssi(folder)


def test_room_is_seeded_and_looks_like_ble():
    a, b = rssi_room(n=80, seed=1), rssi_room(n=80, seed=1)
    assert torch.equal(a.rssi_dbm.nan_to_num(), b.rssi_dbm.nan_to_num())
    heard = ~a.rssi_dbm.isnan()
    assert 0.05 < 1 - heard.double().mean() < 0.4
    assert a.rssi_dbm[heard].min() > -105
    assert a.rssi_dbm[heard].max() < -20
    distance = torch.cdist(a.transmitter_position, a.receiver_position)[heard]
    near = distance < 4
    assert a.rssi_dbm[heard][near].median() > a.rssi_dbm[heard][distance > 12].median() + 8


@pytest.mark.data
def test_measured_rssi(measured_data):
    data = load_rssi(measured_data / "tetam-tracks")
    assert data.rssi_dbm.shape == (1534, 12)
    assert int((~data.rssi_dbm.isnan()).sum()) == 15731
    assert {name: (len(a), len(b)) for name, (a, b) in data.named_splits.items()} == {
        "random": (1227, 307),
        "spatial": (1217, 317),
        "block": (1120, 414),
    }
