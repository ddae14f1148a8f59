"""Tables in documents: JSON of survey tools, tracks in GPX and KML, and what is refused."""

import json
import time
import tracemalloc

import pytest

from swiftwrf import InputError, load_rssi
from swiftwrf.contrib.formats.documents import table_in_document

RSSI = {"hall": -50, "office": -60}
PLACES = [(float(n), float(n * n % 5)) for n in range(12)]


def level(n, name):
    return RSSI[name] - n


def flat(n, x, y):
    return [{"x": x, "y": y, "receiver": name, "rssi": level(n, name)} for name in RSSI]


def nested(n, x, y):
    scan = [{"bssid": name, "rssi": level(n, name), "channel": 6} for name in RSSI]
    return [{"id": n, "position": [x, y], "scan": scan, "tags": [{"tag": "a"}, {"tag": "b"}]}]


def by_name(n, x, y):
    return [{"location": {"x": x, "y": y, "z": 0}, "readings": {name: level(n, name) for name in RSSI}}]


def scans_by_name(n, x, y):
    return [{"x": x, "y": y, "aps": {name: {"RSSI": level(n, name), "channel": 11} for name in RSSI}}]


def scan_events(n, x, y):
    seen = [{"bssid": name, "rssi_dbm": level(n, name), "frequency_mhz": 5180, "noise_dbm": -94} for name in RSSI]
    place = {"coordinate_xyz": {"x": x, "y": y, "unit": "meters"}}
    return [{"id": f"scan-{n}", "coordinate": place, "wifi_observations": seen}]


def document(records):
    """Return records deep inside other content, with lists that are no measurements."""
    path = {"name": "aisle", "path_points": [{"x": 2, "y": 3}] * 50, "scan_events": records}
    return {
        "version": "2.1",
        "floorplans": [{"name": "level 1", "dimensions": [{"width": 60}], "survey_paths": [path]}],
    }


@pytest.mark.parametrize("record", [flat, nested, by_name, scans_by_name, scan_events])
@pytest.mark.parametrize("wrapped", [list, document])
def test_records_in_json(tmp_path, record, wrapped):
    records = [part for n, (x, y) in enumerate(PLACES) for part in record(n, x, y)]
    (tmp_path / "survey.json").write_text(json.dumps(wrapped(records)))
    data = load_rssi(tmp_path / "survey.json")
    assert data.receiver_names == ("hall", "office")
    assert data.rssi_dbm.tolist() == [[level(n, name) for name in RSSI] for n in range(len(PLACES))]
    assert data.transmitter_position[:, :2].tolist() == [list(place) for place in PLACES]
    assert wrapped is list or "rows are the records in floorplans > survey_paths > scan_events" in "".join(data.notes)


def survey(tmp_path, records):
    (tmp_path / "survey.json").write_text(json.dumps(records))
    return load_rssi(tmp_path / "survey.json")


@pytest.mark.parametrize("n", [2, 3, 4])
def test_a_list_of_rssi_is_no_position(tmp_path, n):
    lists = [[-50 - place - 10 * number for number in range(n)] for place in range(12)]
    places = [{"x": x, "y": y} for x, y in PLACES]
    data = survey(tmp_path, [place | {"rssi": values} for place, values in zip(places, lists, strict=True)])
    assert data.receiver_names == tuple(f"rssi_{number}" for number in range(1, n + 1))
    assert data.rssi_dbm.tolist() == lists
    assert data.transmitter_position.tolist() == [[x, y, 0] for x, y in PLACES]
    records = [place | {"B": values[0], "A": values} for place, values in zip(places, lists, strict=True)]
    other = survey(tmp_path, records)
    assert other.receiver_names == ("B",)
    assert other.transmitter_position.tolist() == [[x, y, 0] for x, y in PLACES]
    assert "lists that hold no records, position or RSSI are left out: A" in other.notes


@pytest.mark.parametrize("name", ["position", "pos", "Location", "coordinates", "tx_position", "xyz"])
def test_a_list_of_a_place_is_a_position(tmp_path, name):
    metres = {"coordinates": 1e-5}.get(name, 1.0)
    data = survey(tmp_path, [{name: [8 + metres * x, metres * y, 2], "a": -60} for x, y in PLACES])
    assert bool((data.transmitter_position[:, 2] == 2).all())
    assert float(data.transmitter_position[:, 0].diff().mean()) == pytest.approx(1.1132 if metres < 1 else 1, rel=1e-3)


@pytest.mark.parametrize("empty", [[], {}, None, "absent"])
@pytest.mark.parametrize("by_receiver", [True, False])
def test_a_place_where_nothing_was_detected_is_a_row(tmp_path, empty, by_receiver):
    records = []
    for n, (x, y) in enumerate(PLACES):
        scan = {"hall": {"rssi": -50 - n}} if by_receiver else [{"bssid": "hall", "rssi": -50 - n}]
        records.append({"x": x, "y": y} | ({"scan": scan if n % 2 else empty} if n % 2 or empty != "absent" else {}))
    data = survey(tmp_path, {"site": "a", "points": records})
    assert data.transmitter_position[:, :2].tolist() == [list(place) for place in PLACES]
    assert data.rssi_dbm.nan_to_num(0)[:, 0].tolist() == [-50 - n if n % 2 else 0 for n in range(12)]


def test_survey_points_of_a_heatmap_tool(tmp_path):
    def point(n):
        wifi = {"ssid": "net", "bssid": "0c11", "rssi": -40 - n, "signalStrength": 90 - n, "channel": 36}
        results = {"tcpDownload": {"bitsPerSecond": 5e7, "jitterMs": 1}, "tcpUpload": {"bitsPerSecond": 4e7}}
        return {"x": 20 * n, "y": 40 * n, "wifiData": None if n == 3 else wifi, "iperfData": results, "isEnabled": True}

    content = {"surveyPoints": [point(n) for n in range(12)], "apMapping": [{"apName": "a", "macAddress": "0c11"}]}
    (tmp_path / "survey.json").write_text(json.dumps(content))
    data = load_rssi(tmp_path / "survey.json", scale=20, y_down=True)
    assert data.receiver_names == ("0c11",)
    assert data.rssi_dbm.nan_to_num(0)[:, 0].tolist() == [0 if n == 3 else -40 - n for n in range(12)]
    assert data.transmitter_position[:, :2].tolist() == [[n, -2 * n] for n in range(12)]


TRACKS = {
    ".gpx": (
        '<?xml version="1.0" encoding="UTF-8"?><gpx xmlns="http://www.topografix.com/GPX/1/1" xmlns:r="urn:r"><trk><trkseg>'
        "{}</trkseg></trk></gpx>",
        '<trkpt lat="{y}" lon="{x}"><ele>400</ele><time>2026-01-01T10:00:{n:02}Z</time>'
        "<extensions><r:TrackPointExtension><r:rssi>{rssi}</r:rssi></r:TrackPointExtension></extensions></trkpt>",
    ),
    ".kml": (
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Folder>{}</Folder></Document></kml>',
        "<Placemark><name>p{n}</name><LookAt><longitude>9</longitude><latitude>40</latitude></LookAt>"
        "<TimeStamp><when>2026-01-01T10:00:{n:02}Z</when></TimeStamp><Point><coordinates>{x},{y},400</coordinates></Point>"
        '<ExtendedData><Data name="rssi"><value>{rssi}</value></Data></ExtendedData></Placemark>',
    ),
    ".geojson": (
        '{{"type": "FeatureCollection", "features": [{}]}}',
        '{{"type": "Feature", "geometry": {{"type": "Point", "coordinates": [{x}, {y}, 400]}}, '
        '"properties": {{"rssi": {rssi}, "time": "2026-01-01T10:00:{n:02}Z"}}}}{comma}',
    ),
}


@pytest.mark.parametrize("suffix", TRACKS)
def test_tracks(tmp_path, suffix):
    whole, point = TRACKS[suffix]
    points = ({"n": n, "x": 8.5 + 1e-4 * n, "y": 47.4, "rssi": -60 - n, "comma": "," * (n < 19)} for n in range(20))
    file = tmp_path / f"walk{suffix}"
    file.write_text(whole.format("".join(point.format(**values) for values in points)))
    data = load_rssi(file)
    assert data.rssi_dbm[:, 0].tolist() == [-60 - n for n in range(20)]
    assert data.transmitter_position[:, 2].tolist() == [400] * 20
    assert data.time.tolist() == list(range(20))
    assert float(data.transmitter_position[:, 0].diff().mean()) == pytest.approx(7.55, abs=0.05)


BOMB = '<!DOCTYPE b [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;">]><gpx><wpt lat="1" lon="2">&b;</wpt></gpx>'


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", '{"points": [{"x": 1', "is not a complete JSON document"),
        ("a.json", "[" * 100_000, "is not a complete JSON document"),
        ("a.json", "[[1, 2, -60], [2, 3, -61]]", "holds no records with names"),
        ("a.json", '[{"x": 1, "y": 2, "a": -50, "a": -90}]', "it names 'a' twice"),
        ("a.json", '[{"x": 1, "y": 2, "scan": [{"x": 5, "x": 6, "rssi": -50}]}]', "it names 'x' twice"),
        ("a.json", '[{"ap": "a", "rssi": -60}]', "has no column for x"),
        ("a.json", '[{"x": 1, "y": 2, "note": "quiet"}]', "has no column of RSSI"),
        ("a.json", json.dumps([{"x": x, "y": x, "rssi": -60} for x in (0, 1, 2, 3, 1e999)]), "must be finite"),
        ("a.gpx", "<gpx><trk><trkseg><trkpt lat='1' lon='2'>", "is not a complete GPX document"),
        ("a.gpx", "<gpx><trk><trkseg/></trk></gpx>", "holds no records with names"),
        ("a.gpx", "<gpx><wpt lat='1' lon='2'/></gpx>", "has no column of RSSI"),
        ("a.gpx", "<gpx>" + "<wpt>" * 50_000 + "</wpt>" * 50_000 + "</gpx>", "is not a complete GPX document"),
        ("a.gpx", BOMB, "declares entities"),
        ("a.kml", "<kml><Placemark><coordinates>a,b</coordinates></Placemark></kml>", "is not a complete KML document"),
    ],
)
def test_broken_documents_are_refused_in_one_sentence(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=message):
        load_rssi(tmp_path / name)


# sizes: a short document takes little memory and time, whatever it contains


def around(n):
    """Return n values around n records."""
    return json.dumps({f"k{i}": i for i in range(n)} | {"points": [{"x": i} for i in range(n)]})


def lists(n):
    return json.dumps({f"a{i}": [{"x": 1}] for i in range(n)})


def nested_lists(n):
    return '{"x": 1, "a": [' * n + "{}" + "]}" * n


def attributes(n):
    return f"<gpx><wpt {' '.join(f'a{i}={chr(34)}1{chr(34)}' for i in range(n))}/></gpx>"


@pytest.mark.parametrize(
    ("text", "suffix", "words"),
    [
        (around(3000), ".json", "has 3000 records of 3001 values; at most 4194304 cells"),
        (lists(20_000), ".json", "has lists of records under 20001 names; at most 1000"),
        (nested_lists(300), ".json", "nests records more than 50 deep"),
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
