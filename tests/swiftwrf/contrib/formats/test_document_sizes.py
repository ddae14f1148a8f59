"""A short document takes little memory and time, whatever it holds: the values around records are stored once."""

import json
import time
import tracemalloc

import pytest

from swiftwrf import InputError
from swiftwrf.contrib.formats.documents import table_in_document


def around(n):
    """Return n values around n records."""
    return json.dumps({f"k{i}": i for i in range(n)} | {"points": [{"x": i} for i in range(n)]})


def lists(n):
    return json.dumps({f"a{i}": [{"x": 1}] for i in range(n)})


def nested(n):
    return '{"x": 1, "a": [' * n + "{}" + "]}" * n


def attributes(n):
    return f"<gpx><wpt {' '.join(f'a{i}={chr(34)}1{chr(34)}' for i in range(n))}/></gpx>"


@pytest.mark.parametrize(
    ("text", "suffix", "words"),
    [
        (around(3000), ".json", "has 3000 records of 3001 values; at most 4194304 cells"),
        (lists(20_000), ".json", "has lists of records under 20001 names; at most 1000"),
        (nested(300), ".json", "nests records more than 50 deep"),
        (attributes(100_000), ".gpx", "100000 values; .* 16384 values of a record"),
    ],
    ids=["around", "lists", "nested", "attributes"],
)
def test_what_would_take_far_more_than_its_size_is_refused_at_once(text, suffix, words):
    tracemalloc.start()
    began = time.process_time()
    with pytest.raises(InputError, match=words):
        table_in_document("walk", text, suffix)
    assert time.process_time() - began < 5  # three times as long as measured
    assert tracemalloc.get_traced_memory()[1] < 50 * len(text) + 2**24
    tracemalloc.stop()


def test_values_around_records_are_shared_by_their_rows():
    points = [{"x": i, "y": i, "rssi": -60} for i in range(1000)]
    tracemalloc.start()
    table = table_in_document("walk", json.dumps({f"k{i}": i for i in range(1000)} | {"points": points}), ".json")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert table.shape == (1000, 1003)
    assert peak < 50e6  # two references of 8 bytes a cell, 16 MB; 115 MB with a text a cell and a dictionary a row


def test_each_row_has_its_own_values_and_those_around_it():
    points = [{"x": i, "scan": [{"bssid": f"a{j}", "rssi": -60 - j} for j in range(i)]} for i in range(4)]
    table = table_in_document("walk", json.dumps({"floor": None, "walk": {"day": 3}, "points": points}), ".json")
    expected = [["", "3", str(i), f"a{j}", str(-60 - j)] for i in range(4) for j in range(i)]
    assert [row for row in table.to_numpy().tolist() if row[-1]] == expected


@pytest.mark.parametrize("point", [{"\ud800": -60}, {"bssid": "\udc00", "rssi": -60}], ids=["name", "value"])
def test_half_a_character_is_refused(point):
    with pytest.raises(InputError, match="surrogates not allowed"):
        table_in_document("walk", json.dumps({"points": [{"x": 1, "y": 2} | point]}), ".json")


def test_a_character_of_two_halves_is_one():
    text = json.dumps({"points": [{"x": 1, "y": 2, "\U0001f600": -60}]})
    assert "\\ud83d" in text
    assert list(table_in_document("walk", text, ".json")) == ["x", "y", "\U0001f600"]
