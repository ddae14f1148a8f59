"""Tables of RSSI as people and tools write them: one walk in any form is read the same, and others are refused."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest
import torch
from pyproj import Proj
from samples import walk

from swiftwrf import InputError, Rssi, load_rssi, load_spectra
from swiftwrf.data.coordinates import GeodeticOrigin, PlanFrame
from swiftwrf.data.receivers import read_places
from swiftwrf.data.writing import write_rssi

N = 60
NAMES = ["a", "b", "c", "d"]
ADDRESSES = ["0d:1c:19:95:43:33", "cb:99:d5:23:7d:12", "f9:f7:ba:a0:48:d6", "1d:3e:04:f1:ce:23"]
RECEIVER = pd.DataFrame({"receiver": NAMES, "x": [1.5, 22, 3, 20], "y": [1, 2, 10.5, 11], "z": 2.8})


@pytest.fixture
def table() -> pd.DataFrame:
    return walk()


WALK = walk()
SILENT = np.random.default_rng(1).random((N, 4)) < 0.3


def text(table: pd.DataFrame) -> str:
    return table.to_csv(index=False)


def read(content: pd.DataFrame | str | dict[str, str], folder, **options: Any) -> Rssi:
    """Read a data frame, the text of a table, or the texts of files by name."""
    if isinstance(content, pd.DataFrame):
        return Rssi.from_frame(content, **options)
    for name, part in (content if isinstance(content, dict) else {"walk.csv": content}).items():
        (folder / name).write_text(part)
    return load_rssi(folder, **options)


def noted(data: Rssi, *words: str) -> bool:
    """Return True if a note contains all of these words."""
    return any(all(word in note for word in words) for note in data.notes)


def is_read_as(data: Rssi, table: pd.DataFrame, names=NAMES, atol=1e-6) -> None:
    """Assert that the data are those of the walk, up to the order of receivers and the origin of the metres."""
    assert sorted(data.receiver_names) == sorted(names)
    rssi = data.rssi_dbm[:, [data.receiver_names.index(name) for name in names]]
    np.testing.assert_array_equal(rssi, table[NAMES])
    position = data.transmitter_position[:, :2] - data.transmitter_position[0, :2]
    np.testing.assert_allclose(position, table[["x", "y"]] - table[["x", "y"]].iloc[0], atol=atol)


def silenced(table: pd.DataFrame, word: object = np.nan, silent=SILENT) -> pd.DataFrame:
    """Return the walk with a word or number in the place of RSSI that was not detected."""
    kept = table if isinstance(word, float) else table.astype(str)
    return kept.assign(**kept[NAMES].mask(silent, word))


def long_of(table: pd.DataFrame, receiver: str, rssi: str = "rssi") -> pd.DataFrame:
    """Return the table with a row a packet, packets of a place below each other."""
    packets = table.reset_index(names="t").melt(["t", "x", "y"], var_name=receiver, value_name=rssi)
    return packets.sort_values("t", kind="stable")


def placed(x: str, y: str, values: np.ndarray) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """Return a change of a table to other columns of positions."""
    return lambda t: pd.DataFrame(np.asarray(values), columns=[x, y]).join(t[NAMES])


def in_degrees(x: str, y: str, latitude: float, longitude: float, first="longitude", change=lambda degrees: degrees):
    """Return a change of a table to degrees, longitude or latitude first, in another unit or range."""
    degrees = GeodeticOrigin(latitude, longitude).to_degrees(WALK[["x", "y"]].to_numpy())
    degrees[:, 1] = (degrees[:, 1] + 180) % 360 - 180
    return placed(x, y, change(degrees if first == "latitude" else degrees[:, ::-1]))


def written(power: Callable[[float], str]):
    """Return a change of a table that writes its numbers as text."""
    return lambda t: t[["x", "y"]].map("{} m".format).join(t[NAMES].map(power))


def scaled(unit: str, factor: float):
    """Return a change of a table to lengths in another unit."""
    return lambda t: t.assign(x=factor * t.x, y=factor * t.y).rename(columns={"x": f"x_{unit}", "y": f"y [{unit}]"})


def with_letters(table):
    degrees = GeodeticOrigin(-33.9, -70.2).to_degrees(table[["x", "y"]].to_numpy())
    named = {"Lat": [f"{-value:.8f} S" for value in degrees[:, 0]], "Lon": [f"{-v:.8f}\u00b0W" for v in degrees[:, 1]]}
    return table.assign(**named).drop(columns=["x", "y"])


def minutes(degrees):
    """Degrees and minutes as of NMEA, ddmm.mm."""
    return np.sign(degrees) * (100 * np.floor(abs(degrees)) + 60 * (abs(degrees) % 1)).round(7)


def on_plan(scale: float, *above: str):
    """Return a change of a table to the text of pixels of a floor plan that count down, below lines of text."""
    plan = placed("Map X (px)", "Map Y (px)", scale * np.column_stack([WALK.x, 12 - WALK.y]))
    return lambda t: "\n".join([*above, text(plan(t))])


def shaped(change: Callable[[list[str]], list[str]]):
    """Return a change of the lines of a table."""
    return lambda t: "\n".join(change(text(t).splitlines()))


class Form(NamedTuple):
    """A form of the walk.

    Args:
        change: What was written of the walk.
        words: Words of a note; None if there is none but those of every table.
        options: Of the reader.
        atol: Tolerance of the positions [m], at least a millimetre for degrees.
        scale: Pixels of its plan in a metre.
    """

    change: Callable[[pd.DataFrame], pd.DataFrame | str | dict[str, str]]
    words: tuple[str, ...] | None = ()
    options: dict[str, Any] = {}  # noqa: RUF012
    atol: float = 1e-6
    scale: float | None = None


def other_quantities(*names: str) -> Form:
    values = np.random.default_rng(1).normal(-20, 6, N).round(1)
    return Form(lambda t: t.assign(**dict.fromkeys(names, values)), ("left out", *names))


RECEIVER_COLUMNS = [
    *("gateway_id", "gateway", "gw", "ap", "ap_name", "AP Name", "ap_mac", "mac_address", "MAC", "beacon_id", "anchor"),
    *("sensor", "node", "station", "access_point", "rx_id", "ssid", "BSSID", "cell_id", "pci", "eui", "beacon"),
]
AMBIGUOUS = placed("longitude", "latitude", WALK[["x", "y"]])
FAR = placed("longitude", "latitude", WALK[["x", "y"]] + [361.1, 0])
UTM = placed("longitude", "latitude", WALK[["x", "y"]] + [691_000, 5_300_000])
PROJECTED = ("projected to local metres",)
FORMS = {
    "units": Form(written(lambda v: f"{v:.0f} dBm")),
    "units without space": Form(written(lambda v: f"{v:.1f}dBm")),
    "typographic minus": Form(written(lambda v: f"\u2212{-v:.0f}")),
    "dash for minus": Form(written(lambda v: f"\u2013{-v:.0f}")),
    "centimetres": Form(scaled("cm", 100.0), ("cm in a metre",)),
    "millimetres": Form(scaled("mm", 1000.0), ("mm in a metre",)),
    "feet": Form(scaled("ft", 1 / 0.3048), ("ft in a metre",)),
    **{f"receivers in {c}": Form(lambda t, c=c: long_of(t, c).assign(snr=-3.5, device="a")) for c in RECEIVER_COLUMNS},
    "cellular": other_quantities("RSRQ [dB]", "SINR", "rssnr", "CQI"),
    "radio": other_quantities("SNR", "noise_floor", "TxPower", "tx_pwr_dbm"),
    "sensors": other_quantities("mag_x", "magY", "accZ", "gyro_z", "roll", "Pitch", "heading", "temperature"),
    "estimates": other_quantities("x_est", "est_y", "odom_x", "y_hat", "x_pred"),
    "unknown": other_quantities("drift"),
    # degrees
    "by name": Form(in_degrees("longitude", "latitude", 52.51, 13.4), PROJECTED, {}, 1e-3),
    "the other way round": Form(in_degrees("Lat", "Lng", -33.85, 151.2, "latitude"), PROJECTED, {}, 1e-3),
    "of a phone": Form(in_degrees("GPS Longitude", "GPS Latitude", 40.7, -74.0), PROJECTED, {}, 1e-3),
    "called x and y": Form(in_degrees("X", "Y", 35.68, 139.7), PROJECTED, {}, 1e-3),
    "called x and y, swapped": Form(in_degrees("x", "y", -33.4, -100.6, "latitude"), PROJECTED, {}, 1e-3),
    "called pos_x and pos_y": Form(in_degrees("pos_x", "pos_y", -1.29, 36.8), PROJECTED, {}, 1e-3),
    "across the antimeridian": Form(in_degrees("lon", "lat", -17.7, 180.0), PROJECTED, {}, 1e-3),
    "degrees with letters": Form(with_letters, (), {}, 0.01),
    **{
        f"{name} at {at}": Form(in_degrees("longitude", "latitude", *at, change=change), (words,), {}, 0.03)
        for at in ((47.4, 8.5), (-33.9, 151.2), (52.5, -1.4))
        for name, change, words in (
            ("ten millionths", lambda d: np.round(1e7 * d).astype(int), "converted to degrees"),
            ("degrees and minutes", minutes, "longitude longitude and latitude latitude are projected"),
        )
    },
    **{
        f"{x} from 0 to 360 about {at}": Form(
            in_degrees(x, y, 40.7, at, change=lambda d: d % [360, 91]), ("count from 0 to 360 degrees",), given, 1e-3
        )
        for at in (-74.1, 179.9999, -179.9999)
        for x, y, given in (("longitude", "latitude", {}), ("x", "y", {"coordinates": "degrees"}))
    },
    "metres that are called latitude": Form(placed("longitude", "latitude", WALK[["x", "y"]] + [-7541.26, 4864921.5])),
    "metres as asked": Form(AMBIGUOUS, (), {"coordinates": "metres"}),
    "far metres as asked": Form(FAR, (), {"coordinates": "metres"}),
    "metres that none can be degrees": Form(UTM, ("count as metres, because none of their values can be degrees",)),
    # pixels
    **{
        f"{above} {scale}": Form(on_plan(scale, "Survey export", above.format(scale), ""), scale=scale)
        for above in ("Scale: 1 m = {} px", "{} px/m", "pixels per meter: {}")
        for scale in (20.7, 8.0)
    },
    "pixels with their scale": Form(on_plan(20.7), (), {"scale": 20.7}, scale=20.7),
    "plain pixels": Form(
        placed("x", "y", 20.7 * np.column_stack([WALK.x, 12 - WALK.y])), (), {"scale": 20.7, "y_down": True}, scale=20.7
    ),
    # lines
    "as written": Form(text, None),
    "header repeated": Form(shaped(lambda line: [*line[:20], line[0], *line[20:40], line[0], *line[40:]]), ("header",)),
    "hash before the header": Form(shaped(lambda line: [f"# {line[0]}", *line[1:]]), None),
    "last columns without cells": Form(shaped(lambda line: [f"{line[0]},remark,tag", *line[1:]]), ("remark",)),
    "separators at the end": Form(shaped(lambda line: [line[0], *(f"{each},," for each in line[1:])]), None),
    "columns without content": Form(shaped(lambda line: [f"{each},," for each in line]), None),
    "rows without content": Form(shaped(lambda line: [*line, ",,,,,", ",,,,,"]), None),
    "index of a data frame": Form(lambda t: t.to_csv(), None),
    "second header": Form(shaped(lambda line: [line[0], ",,HomeNet,HomeNet_5G,Guest,Printer", *line[1:]]), ("header",)),
    "row of units": Form(shaped(lambda line: [line[0], "m,m,dBm,dBm,dBm,dBm", *line[1:]]), ("header",)),
    "lines above": Form(shaped(lambda line: ["Survey export", "Project: office, 2nd floor", "", *line]), ("header",)),
    "semicolons and decimal commas": Form(lambda t: t.to_csv(index=False, sep=";", decimal=",")),
    "decimal commas in quotes": Form(lambda t: t.to_csv(index=False, decimal=","), None),
    "points between thousands": Form(
        lambda t: (
            t.assign(x=t.x + 2000, y=t.y + 3000)
            .map(lambda v: f"{v:,.2f}".translate(str.maketrans(",.", ".,")))
            .to_csv(index=False, sep=";")
        )
    ),
    "poses of ROS": Form(
        lambda t: (
            t.rename(columns={axis: f"field.pose.pose.position.{axis}" for axis in "xy"})
            .assign(**{"field.pose.pose.orientation.x": -0.4, "field.pose.pose.orientation.y": 0.9})
            .assign(**{"%time": 1_780_000_000_000_000_000 + 500_000_000 * np.arange(N)})
        )
    ),
    "names of axes": Form(lambda t: t.rename(columns={"x": "Pos X (m)", "y": "pos_y"})),
}


@pytest.mark.parametrize("name", FORMS)
def test_a_walk_in_any_form_is_read_the_same(table, tmp_path, name):
    form = FORMS[name]
    data = read(form.change(table), tmp_path, **form.options)
    is_read_as(data, table, atol=form.atol)
    assert not form.words or noted(data, *form.words)
    assert form.words is not None or len(data.notes) == 2  # columns and heights
    assert (data.origin is not None) == (form.atol >= 1e-3)
    assert data.plan_scale == form.scale


def test_a_written_table_has_its_name_and_says_how_it_was_taken(table, tmp_path):
    data = read(text(silenced(table, -100.0)), tmp_path)
    is_read_as(data, silenced(table))
    assert (data.name, data.located) == ("walk", False)
    assert data.notes[0] == "taken as: x = x, y = y, RSSI of 4 receivers = a, b, c, d"
    assert noted(data, f"-100 counts as not detected: {SILENT.sum()} of {4 * N} cells ({SILENT.mean():.0%})")
    again = read(text(table.iloc[[*range(N), 3, 3]]), tmp_path)
    assert noted(again, f"rows equal an earlier one in all columns and count once more: 2 of {N + 2}")


def test_commas_between_thousands_are_no_decimal_commas(table, tmp_path):
    """A quoted 1,250 may be 1.25 or 1250: such a table is refused, unless other cells decide."""
    table[["x", "y"]] = (100 * table[["x", "y"]]).round() + 1000
    grouped = table.assign(x=table.x.map("{:,.0f}".format), y=table.y.map("{:,.0f}".format))
    for doubtful in (grouped.astype(dict.fromkeys(NAMES, int)), grouped):
        with pytest.raises(InputError, match="is not a number"):
            read(text(doubtful), tmp_path)


def test_parquet(table, tmp_path):
    silenced(table).to_parquet(tmp_path / "walk.parquet")
    for place in (tmp_path, tmp_path / "walk.parquet"):
        is_read_as(load_rssi(place), silenced(table))
    times = [*pd.date_range("2026-01-01", periods=11, freq="s"), pd.NaT]
    long = pd.DataFrame({"x": range(12), "y": 1.0, "z": 1.0, "time": times, "receiver": "a", "rssi": -50.0})
    long.to_parquet(tmp_path / "walk.parquet")
    assert len(load_rssi(tmp_path)) == 12
    long.assign(receiver=["a"] * 4 + [None] + ["a"] * 7).to_parquet(tmp_path / "walk.parquet")
    with pytest.raises(InputError, match="row 5 has no receiver"):
        load_rssi(tmp_path)


def in_zones(table, letter="U", border=12.0):
    """Return the walk with x and y as UTM coordinates of the zones on either side of 12 degrees east."""
    origin = GeodeticOrigin(48.0, border)
    degrees = origin.to_degrees(np.column_stack([table.x - 10, table.y]))
    zones = np.where(degrees[:, 1] < border, 32, 33)
    both = {zone: Proj(proj="utm", zone=zone, ellps="WGS84")(degrees[:, 1], degrees[:, 0]) for zone in (32, 33)}
    x, y = (np.where(zones == 32, both[32][axis], both[33][axis]) for axis in (0, 1))
    return table.assign(x=x, y=y, zone=[f"{zone}{letter}" for zone in zones]), np.column_stack(both[32])


def test_zones_of_utm_are_joined(table):
    written, expected = in_zones(table)
    data = Rssi.from_frame(pd.concat([written, written[written.zone == "32U"]]).drop_duplicates())
    in_main = written.zone.mode()[0] == "32U"
    xy = data.transmitter_position[:, :2].numpy()
    step = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    np.testing.assert_allclose(step, np.linalg.norm(np.diff(expected, axis=0), axis=1), rtol=1e-4)
    assert not in_main or np.allclose(xy, expected, atol=1e-3)
    assert noted(data, "positions in UTM zones 32U, 33U are those of zone")
    assert not data.labels


def test_zones_of_unknown_hemisphere_are_refused(table):
    for letter in ("", "S"):
        with pytest.raises(InputError, match="hemisphere of 32"):
            Rssi.from_frame(in_zones(table, letter)[0])
    areas = table.assign(zone=np.where(table.x < 10, "1", "2"))
    is_read_as(Rssi.from_frame(areas), table)


# receivers


@pytest.mark.parametrize("long", [False, True])
def test_relayed_packets_are_no_rssi_of_this_place(table, long):
    """A relay sends from another place, so its packets are left out, and the rest is the table without them."""
    mesh = table[["x", "y", "a"]].rename(columns={"a": "rx_rssi"}).assign(rx_snr=4.5)
    mesh = mesh.assign(gateway_id="!7c5a01f2") if long else mesh
    relayed = np.arange(N) % 3 == 1
    hops = {"hops_away": np.where(relayed, 2, 0)}, {"hop_start": 3, "hop_limit": np.where(relayed, 1, 3)}
    for columns in hops:
        data = Rssi.from_frame(mesh.assign(**columns).assign(rx_rssi=np.where(relayed, -30.0, mesh.rx_rssi)))
        np.testing.assert_array_equal(data.rssi_dbm[:, 0], table.a[~relayed])
        np.testing.assert_array_equal(data.index, np.flatnonzero(~relayed))
        assert noted(data, f"packets that a relay sent are left out: {relayed.sum()} of {N}")
        assert not data.labels


@pytest.mark.parametrize("name", ["RSRP", "rssi", "RSS [dBm]", "Signal Strength", "level"])
def test_one_quantity_is_the_received_power(table, name):
    cell = table[["x", "y", "a"]].rename(columns={"a": name}).assign(PCI=7, RSRQ=-11.5, SNR=table.b / 10)
    assert Rssi.from_frame(cell).receiver_names == (name,)
    assert Rssi.from_frame(cell, columns={"rssi": "RSRQ"}).receiver_names == ("RSRQ",)
    data = Rssi.from_frame(cell.assign(cell_id=["17", "18"] * (N // 2), RSRP=cell[name]).drop(columns="PCI"))
    assert data.receiver_names == ("17", "18")


def test_a_receiver_that_is_named_unlike_the_others_is_pointed_out(table):
    data = Rssi.from_frame(table.set_axis(["x", "y", "AP1", "AP2", "AP3", "hx"], axis=1))
    assert len(data.receiver_names) == 4
    assert noted(data, "named unlike the others: hx")


@pytest.mark.parametrize("names", [["gateway", "device"], ["ap", "b"], ["rx", "b"], ["sensor", "mac"]])
def test_a_receiver_called_gateway(table, names):
    wide = table[["x", "y", "a", "b"]].set_axis(["x", "y", *names], axis=1)
    for columns in (None, {"rssi": "*"}):
        data = Rssi.from_frame(wide, columns=columns)
        assert data.receiver_names == tuple(names)
        np.testing.assert_array_equal(data.rssi_dbm, table[["a", "b"]])


@pytest.mark.parametrize("name", ["hotspot", "Netzwerk", "peer"])
@pytest.mark.parametrize("moving", [False, True])
def test_a_column_that_may_be_the_receiver_is_asked_about(table, name, moving):
    packets = long_of(table, name)
    if moving:  # each packet has a place of its own
        packets = packets.assign(x=packets.x + 0.01 * np.arange(len(packets)), t=np.arange(len(packets)))
    with pytest.raises(InputError, match=f"is '{name}' the receiver of each row.*receiver={name}"):
        Rssi.from_frame(packets)
    assert len(Rssi.from_frame(packets, columns={"receiver": name}).receiver_names) == 4
    assert Rssi.from_frame(packets, columns={"rssi": "rssi"}).receiver_names == ("rssi",)


def test_columns_that_are_no_receivers_are_not_asked_about(table):
    one = table[["x", "y", "a"]].rename(columns={"a": "rssi"})
    halves = np.where(one.x < 9, "west", "east")
    data = Rssi.from_frame(one.assign(wing=halves, phone=["p", "q"] * (N // 2), sf=["SF7", "SF9", "SF12"] * (N // 3)))
    assert data.receiver_names == ("rssi",)


@pytest.mark.parametrize("name", ["Level", "Map", "Ebene"])
def test_a_column_named_like_levels_is_the_floor_by_its_values_or_asked_about(table, name):
    third = np.repeat(["Ground floor", "1st floor", "2nd floor"], N // 3)
    data = Rssi.from_frame(table.assign(**{name: third}))
    assert list(data.floors.names) == ["Ground floor", "1st floor", "2nd floor"]
    assert data.transmitter_position[:, 2].tolist() == np.repeat([0.0, 4.0, 8.0], N // 3).tolist()
    with pytest.raises(InputError, match=rf"is '{name}' \(office, store\) the floor .*--columns floor={name}"):
        Rssi.from_frame(table.assign(**{name: ["office", "store"] * (N // 2)}))
    battery = Rssi.from_frame(table.assign(**{name: 87}))
    assert battery.floors is None


def test_measurements_of_another_kind_are_named(table, tmp_path):
    table.to_csv(tmp_path / "walk.csv", index=False)
    words = "walk.csv looks like RSSI, which swiftwrf rssi and swiftwrf locate can read; expected array snapshots or spectra"
    with pytest.raises(InputError, match=words):
        load_spectra(tmp_path / "walk.csv")


def test_columns_named_by_the_user(table):
    named = table.rename(columns={"x": "easting_of_robot", "a": "ap one", "b": "ap two"})
    data = Rssi.from_frame(named, columns={"x": "easting_of_robot", "rssi": "ap *"})
    assert data.receiver_names == ("ap one", "ap two")
    named = table.rename(columns={"a": "a[1]", "b": "a1"})
    assert Rssi.from_frame(named, columns={"rssi": "a[1]"}).receiver_names == (
        "a[1]",
    )  # no pattern, as there is such a name


def test_one_row_of_a_stream_keeps_its_receivers(table):
    assert Rssi.from_frame(table.iloc[:1].assign(a=-11.5, noise=-95)).receiver_names == tuple(NAMES)


def test_packets_of_one_place_have_a_row_each():
    rows = [[1, 1, "a", -50], [1, 1, "b", -60], [1, 1, "a", -52], [2, 2, "b", -70]]
    data = Rssi.from_frame(pd.DataFrame(rows, columns=["x", "y", "Receiver Name", "RSSI [dBm]"]))
    assert data.rssi_dbm.nan_to_num(0).tolist() == [[-50, -60], [-52, 0], [0, -70]]
    assert data.transmitter_position[:, 0].tolist() == [1, 1, 2]
    assert "no height" in data.notes[1]


SPELLINGS = {
    "capitals": str.upper,
    "dashes": lambda name: name.replace(":", "-"),
    "no separators": lambda name: name.replace(":", "").upper(),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("n", [2, 4])
def test_names_of_receivers_in_another_spelling(table, tmp_path, spelling, n):
    names = [*map(SPELLINGS[spelling], ADDRESSES[:n]), *ADDRESSES[n:]]
    phones = [table.set_axis(["x", "y", *own], axis=1) for own in (ADDRESSES, names)]
    data = read({"walk.csv": text(phones[0]), "receivers.csv": text(RECEIVER.assign(receiver=names))}, tmp_path)
    assert data.receiver_position[:, 0].tolist() == RECEIVER.x.tolist()
    assert noted(data, "spelled differently", f"{names[0]} is {ADDRESSES[0]}")
    long = pd.concat(phones).melt(["x", "y"], var_name="bssid", value_name="rssi").dropna()
    assert set(Rssi.from_frame(long).receiver_names) == set(ADDRESSES)


def test_zeros_before_numbers_of_receivers(table, tmp_path):
    table = table.set_axis(["x", "y", "1", "2", "10", "11"], axis=1)
    places = RECEIVER.assign(receiver=["01", "02", "010", "11"])
    data = read({"walk.csv": text(table), "receivers.csv": text(places)}, tmp_path)
    assert data.receiver_position[:, 0].tolist() == RECEIVER.x.tolist()


def radios(noise_db=5.0, n_radios=6):
    """Rows of two access points, named by the walk's receivers a and b, with several radios each."""
    draw, names = np.random.default_rng(0), ["x", "y"]
    names += [f"a4:56:cc:00:1{ap}:b{radio}" for ap in range(2) for radio in range(n_radios)]
    power = WALK[["a", "b"]].to_numpy().repeat(n_radios, axis=1) + noise_db * draw.normal(size=(N, 2 * n_radios))
    return pd.DataFrame(np.hstack([WALK[["x", "y"]], power]), columns=names)


def test_radios_of_an_access_point_are_pooled_by_the_mean_of_their_powers(tmp_path):
    table = radios()
    wide = Rssi.from_frame(table, pool_by="mac")
    assert wide.receiver_names == ("a4:56:cc:00:10", "a4:56:cc:00:11")
    np.testing.assert_allclose(wide.rssi_dbm[:, 0], 10 * np.log10((10 ** (table.iloc[:, 2:8] / 10)).mean(axis=1)))
    assert "12 radios are pooled into 2 receivers by mac: mean of their powers" in wide.notes
    long = table.assign(time=range(N)).melt(["x", "y", "time"], var_name="bssid", value_name="rssi")
    long["ssid"] = ["hall" if ":10:" in name else "lab" for name in long.bssid]
    files = {"walk.csv": text(long), "receivers.csv": "receiver,x,y,z\nhall,0,0,0\nlab,20,20,0\n"}
    data = read(files, tmp_path, pool_by="ssid")
    assert data.receiver_names == ("hall", "lab")
    assert data.receiver_position[1].tolist() == [20, 20, 0]
    torch.testing.assert_close(data.rssi_dbm, wide.rssi_dbm)
    long.loc[0, "ssid"] = "lab"
    with pytest.raises(InputError, match="has several values in column 'ssid'"):
        Rssi.from_frame(long, pool_by="ssid")
    some = {"hall-2G": -50.0, "hall-5G": [-50.0, np.nan, -100.0] * 4, "lab": -70.0}
    data = Rssi.from_frame(pd.DataFrame({"x": range(12), "y": 0.0} | some), pool_by="(.*)-.G")
    assert data.receiver_names == ("hall", "lab")
    assert data.rssi_dbm[:, 0].unique().tolist() == pytest.approx([-50.0])  # what a radio does not detect is no power


# positions


def test_positions_of_receivers_beside_the_table(table, tmp_path):
    data = read({"walk.csv": text(table), "receivers.csv": text(RECEIVER[::-1])}, tmp_path)
    np.testing.assert_allclose(data.receiver_position, RECEIVER[["x", "y", "z"]])
    assert set(data.source) == {"walk.csv", "receivers.csv"}
    data = read({"receivers.csv": text(RECEIVER[:3])}, tmp_path)
    assert noted(data, "d", "no path-loss model")
    for unknown in ("d,,,\n", ""):
        assert read({"receivers.csv": text(RECEIVER[:3]) + unknown}, tmp_path).receiver_located.tolist() == [
            True
        ] * 3 + [False]
    for line in ("", "d: null\n", "d:\n"):
        write_rssi(data, tmp_path)
        with (tmp_path / "gateway_position.yml").open("a") as stream:
            stream.write(line)
        (tmp_path / "walk.csv").unlink(missing_ok=True)
        assert load_rssi(tmp_path).receiver_located.tolist() == [True, True, True, False]


@pytest.mark.parametrize("turn", [0, 360])
def test_receivers_in_degrees(table, tmp_path, turn):
    origin = GeodeticOrigin(40.7, -74.1)
    degrees = origin.to_degrees(RECEIVER[["x", "y"]].to_numpy())
    place = pd.DataFrame(
        {"receiver": NAMES, "latitude": degrees[:, 0], "longitude": degrees[:, 1] + turn, "altitude": 2.8}
    )
    walked = in_degrees("lon", "lat", *origin)(table)
    data = read({"walk.csv": text(walked), "receivers.csv": text(place)}, tmp_path)
    expected = table[["x", "y"]].to_numpy()[:, None] - RECEIVER[["x", "y"]].to_numpy()
    apart = data.transmitter_position[:, None] - data.receiver_position
    np.testing.assert_allclose(apart[..., :2], expected, atol=1e-3)
    with pytest.raises(InputError, match=r"receivers\.csv: positions must be in degrees"):
        read({"receivers.csv": text(RECEIVER)}, tmp_path)
    with pytest.raises(InputError, match="holds longitudes and latitudes, but the measurements are in metres"):
        read({"walk.csv": text(table), "receivers.csv": text(place)}, tmp_path)


def test_a_drive_of_degrees(table):
    drive = table.assign(x=23.7 + table.x / 100, y=61.5 + table.y / 100)
    extent = np.ptp(Rssi.from_frame(drive, coordinates="degrees").transmitter_position.numpy(), axis=0)
    assert extent[:2] == pytest.approx([11_980, 11_040], rel=0.01)  # of 0.225 and 0.099 degrees at 61.5 degrees
    assert not Rssi.from_frame(drive, coordinates="metres").origin


def test_y_that_points_up(table, tmp_path):
    """Receivers beside the table have its axes."""
    phone = table.assign(z=-table.y, y=0.1 * np.sin(table.x))[["x", "y", "z", *NAMES]]
    files = {"walk.csv": text(phone), "receivers.csv": "receiver,x,y,z\na,3,1.4,-2\n"}
    assert noted(read(files, tmp_path), "if y is the height, give --up y")
    data = read(files, tmp_path, up="y")
    is_read_as(data, table)
    assert data.receiver_position[0].tolist() == [3, 2, 1.4]


@pytest.mark.parametrize("fix", [np.nan, 0, -1, 999, -9999])
def test_rows_without_a_fix_are_left_out(table, tmp_path, fix):
    lost = np.isin(np.arange(N), np.random.default_rng(0).choice(N, 9, replace=False))
    table.loc[lost, ["x", "y"]] = fix
    table["z"] = np.where(lost, fix, 1.1)
    days = {
        f"{part}_index_days.txt": "\n".join(map(str, r)) for part, r in (("train", range(30)), ("test", range(30, N)))
    }
    data = read({"walk.csv": text(table)} | days, tmp_path)
    is_read_as(data, table[~lost])
    np.testing.assert_array_equal(data.index, np.flatnonzero(~lost))
    assert noted(data, "left out", f"9 of {N}")
    train, test = data.split("days")
    assert (len(train), len(test)) == ((~lost)[:30].sum(), (~lost)[30:].sum())
    assert int(train.index.max()) < 30 <= int(test.index.min())


def test_the_corner_of_a_grid_is_a_position():
    grid = [[0.5 * i, 0.5 * j, 1.0, -60 - i - j] for i in range(6) for j in range(6) for _ in range(3)]
    assert len(Rssi.from_frame(pd.DataFrame(grid, columns=["x", "y", "z", "ap"]))) == 108
    near = [[0.3 + 0.5 * i, 0.3 + 0.2 * i, 1.2, -50.0 - i] for i in range(12)]
    for height, n in ((1.2, 12), (0, 13)):  # one row at the origin has no fix where it alone has no height
        rows = [*([x, y, height, rssi] for x, y, _, rssi in near), [0, 0, 0, -60]]
        assert len(Rssi.from_frame(pd.DataFrame(rows, columns=["x", "y", "z", "a"]))) == n


@pytest.mark.parametrize("every", [2, 4])
def test_scans_that_are_repeated_at_other_places(table, tmp_path, every):
    stale = table.assign(**table[NAMES].iloc[np.arange(N) // every * every].reset_index(drop=True))
    data = Rssi.from_frame(stale)
    np.testing.assert_array_equal(data.index, np.arange(0, N, every))
    assert noted(data, "cached scans", f"{N - len(data)} of {N}")
    parts = {f"{part}_index.txt": "\n".join(map(str, r)) for part, r in (("train", range(40)), ("test", range(40, N)))}
    assert len(read({"walk.csv": text(stale)} | parts, tmp_path)) == N  # a published split stays as it is
    assert len(Rssi.from_frame(stale.assign(x=1.0, y=2.0))) == N  # measured again at one place
    assert len(Rssi.from_frame(table)) == N


# powers


@pytest.mark.parametrize(
    "word", ["--", "---", "n/a", "N.D.", "not heard", "Not detected", "no signal", "", "*", "lost"]
)
def test_words_for_not_detected(table, word):
    found = silenced(table, word)
    data = Rssi.from_frame(found)
    is_read_as(data, silenced(table))
    assert noted(data, "'lost' counts as not detected") == (word == "lost")
    found.loc[3, "a"], found.loc[4, "b"] = "lost", "loud"
    with pytest.raises(InputError, match="is not a number"):
        Rssi.from_frame(found)


@pytest.mark.parametrize("fraction", [0.1, 0.6])
@pytest.mark.parametrize("filler", [127, 100, 0, 1, 255, -105, -98, -110, -127, -200, -100, -np.inf, np.nan])
def test_fillers_are_no_power(table, tmp_path, filler, fraction):
    """Also where a few real values lie just above a filler at the lower edge."""
    if -150 < filler < -90:
        table.loc[:2, "a"], table.loc[3:4, "b"] = filler + 1, filler + 2
    silent = np.random.default_rng(3).random((N, 4)) < fraction
    data = read(text(silenced(table, float(filler), silent)), tmp_path)
    is_read_as(data, silenced(table, silent=silent))
    assert np.isnan(filler) or noted(data, f"{filler} counts as not detected", f"{silent.sum()} of {silent.size}")
    long = long_of(silenced(table, float(filler), silent).assign(x=range(N)), "receiver")
    assert Rssi.from_frame(long).rssi_dbm.isnan().sum() == silent.sum()


def test_the_user_decides_on_fillers(table):
    filled = silenced(table, -104.0)
    assert not Rssi.from_frame(filled, filler=[]).rssi_dbm.isnan().any()
    weakest = table[NAMES].min(axis=None)
    is_read_as(Rssi.from_frame(filled, filler=[weakest]), filled.mask(filled == weakest))


def test_sound_values_are_no_fillers(table):
    """Weakest and strongest values of usual tables, one of them at -100 dBm and below."""
    for shift in (0, -25, 40):
        data = Rssi.from_frame(table.assign(**table[NAMES] + shift))
        assert not data.rssi_dbm.isnan().any()
        assert not noted(data, "not detected")
    weak = pd.DataFrame({"x": range(12), "y": range(12), "z": 1, "rsrp": -95.0 - np.arange(12)})
    data = Rssi.from_frame(weak)
    assert not data.rssi_dbm.isnan().any()
    assert "counts as measured" in data.notes[1]


def test_a_filler_of_receivers_some_of_which_detect_every_row():
    draw = np.random.default_rng(0)
    weak = np.maximum(draw.normal(-92, 8, (80, 4)).round(), -92)
    values = np.hstack([draw.uniform(0, 9, (80, 2)), weak, draw.normal(-50, 8, (80, 2)).round()])
    data = Rssi.from_frame(pd.DataFrame(values, columns=["x", "y", *NAMES, "near", "nearer"]))
    assert noted(data, "-92 counts as not detected")


@pytest.mark.parametrize("highest", [-64, -67])
def test_the_upper_end_of_the_scale_is_named(table, highest):
    data = Rssi.from_frame(table.clip(upper=table.where(table > 0, highest)))
    count = int((data.rssi_dbm == highest).sum())
    assert noted(data, f"the scale ends at {highest} dBm", f"{count} of {4 * N} cells")
    assert not noted(Rssi.from_frame(table), "the scale ends")


# times


START = pd.Timestamp("2024-03-09 16:00:00", tz="UTC")


def moments(form: str) -> Callable[[np.ndarray], dict[str, object]]:
    return lambda s: {"timestamp": [f"{START + pd.Timedelta(seconds=v):{form}}" for v in s]}


def clock(s):
    return {"time": [f"{pd.Timestamp('2024-01-01 23:59:30') + pd.Timedelta(seconds=v):%H:%M:%S}" for v in s]}


def two_columns(s):
    day = START + pd.to_timedelta(1200 * s, unit="s")  # over midnights
    return {"Date": day.strftime("%d.%m.%Y"), "Time": day.strftime("%H:%M:%S")}


TIMES = {  # columns by seconds, and words of a note
    "seconds": (lambda s: {"timestamp": s}, ""),
    "epoch": (lambda s: {"timestamp": START.timestamp() + s}, ""),
    "milliseconds": (lambda s: {"timestamp": (1000 * (START.timestamp() + s)).astype("int64")}, "milliseconds"),
    "microseconds": (lambda s: {"timestamp": (1e6 * (START.timestamp() + s)).astype("int64")}, "microseconds"),
    "nanoseconds": (lambda s: {"timestamp": [(START + pd.Timedelta(seconds=v)).value for v in s]}, "nanoseconds"),
    "14 digits": (moments("%Y%m%d%H%M%S"), ""),
    "17 digits": (moments("%Y%m%d%H%M%S000"), ""),
    "dates": (moments("%Y-%m-%dT%H:%M:%SZ"), ""),
    "dates with the day first": (moments("%d.%m.%Y %H:%M:%S"), ""),
    "milliseconds from a start": (lambda s: {"time_ms": (1000 * (s + s**2 / 1000)).round().astype(int)}, "seconds"),
    "decimal comma": (lambda s: {"time": [f"{v:.1f}".replace(".", ",") for v in s]}, ""),
    "durations": (lambda s: {"time": pd.to_timedelta(s, unit="s")}, ""),
    "a clock": (clock, "pass midnight"),
    "two columns": (two_columns, "Date and Time together are the time"),
    "a word": (
        lambda s: {"time": ["noon" if v % 30 == 9 else f"{v}" for v in s]},
        "no time are unknown: 6 of 60, e.g. 'noon'",
    ),
}


@pytest.mark.parametrize("kind", TIMES)
def test_times_in_any_form(table, kind):
    columns, words = TIMES[kind]
    seconds = 3.0 * np.arange(N)
    data = Rssi.from_frame(table.assign(**columns(seconds)))
    expected = {
        "milliseconds from a start": (seconds + seconds**2 / 1000).round(3),
        "two columns": 1200 * seconds,
        "a word": np.where(seconds % 30 == 9, np.nan, seconds),
    }.get(kind, seconds)
    np.testing.assert_allclose(data.time, expected, atol=1e-3)
    assert noted(data, words or "seconds") == bool(words)


def packets(seed: int, unit: float, cycle: float) -> pd.DataFrame:
    """A log of a walk at 1 m/s: four receivers have a packet each at a random time of a cycle, with its own place."""
    draw = np.random.default_rng(seed)
    time = cycle * (0.37 + np.arange(100)[:, None] + draw.uniform(0, 0.8, (100, 4)))
    order = time.ravel().argsort()
    time, anchor = time.ravel()[order], np.tile(np.arange(4), 100)[order]
    xy = np.column_stack([np.abs(time % 40 - 20), 3 * np.floor(time / 20)])
    at = draw.uniform((0, 0), (20, 12), (4, 2))
    rssi = (-45 - 22 * np.log10(1 + np.linalg.norm(xy - at[anchor], axis=1)) + draw.normal(0, 2, 400)).round()
    log = {"timestamp": (unit * (time - time[0])).round(0 if unit > 1 else 3), "x": xy[:, 0], "y": xy[:, 1]}
    return pd.DataFrame(log | {"anchor": anchor.astype(str), "rssi": rssi})


@pytest.mark.parametrize("unit", [1.0, 1000.0])
@pytest.mark.parametrize("cycle", [1.0, 2.5])
def test_packets_are_joined_in_windows(unit, cycle):
    log = packets(4, unit, cycle)
    assert noted(Rssi.from_frame(log), "--window 1")
    data = Rssi.from_frame(log, window=cycle)
    assert noted(data, "400 rows are joined to 100", f"windows of {cycle:g} s")
    for number, name in enumerate(data.receiver_names):
        np.testing.assert_array_equal(data.rssi_dbm[:, number], log.rssi[log.anchor == name])
    np.testing.assert_allclose(data.transmitter_position[0, :2], log[["x", "y"]][:4].mean(), atol=1e-9)


def test_rows_of_two_devices_in_one_window_stay_apart():
    row = np.arange(60)
    log = pd.DataFrame(
        {"time": row / 4, "x": row / 4 + 100 * (row % 2), "y": row % 7, "device": np.array(["a", "b"])[row % 2]}
    )
    data = Rssi.from_frame(log.assign(ap1=-50.0 - row % 11, ap2=-60.0 - row % 5), window=2.0, offset_by="device")
    x = data.transmitter_position[:, 0].numpy()
    assert len(data) < 20
    assert ((x > 90) == (data.groups == "b")).all()
    assert ((x < 20) | (x > 99)).all()


@pytest.mark.parametrize("long", [False, True])
def test_sessions_of_a_table(table, long):
    """Packets of two sessions at one position do not share a row."""
    table = table[:12].assign(walk=["out", "back"] * 6)
    if long:
        table.loc[1, ["x", "y"]] = table.loc[0, ["x", "y"]]
        table = table.melt(["x", "y", "walk"], var_name="receiver", value_name="rssi")
    data = Rssi.from_frame(table)
    assert len(data) == 12
    assert data.session.bincount().tolist() == [6, 6]
    assert Rssi.from_frame(table.rename(columns={"walk": "hour"}), columns={"session": "hour"}).session is not None


# files of others


@pytest.mark.parametrize(
    "names", [("trn01rss.csv", "trn01crd.csv"), ("Training_rss_21Aug.csv", "Training_coordinates_21Aug.csv")]
)
@pytest.mark.parametrize("header", [False, True])
def test_rssi_and_coordinates_in_two_files(table, tmp_path, names, header):
    rssi, weak = table[NAMES], table[NAMES] < -75
    place = table[["x", "y"]].sub([40, 30]).assign(z=3.5)  # negative
    parts = [part.to_csv(index=False, header=header) for part in (rssi.mask(weak, 100).astype(int), place)]
    data = read(dict(zip(names, parts, strict=True)), tmp_path)
    is_read_as(data, silenced(table, silent=weak), NAMES if header else [f"receiver{i}" for i in range(1, 5)])
    assert float(data.transmitter_position[0, 2]) == 3.5
    assert set(data.source) == set(names)
    if not header:
        table[["x"]].to_csv(tmp_path / "trn01tms.csv", index=False, header=False)
        assert len(load_rssi(tmp_path / names[0])) == N
        with pytest.raises(InputError, match="holds 3 tables"):
            load_rssi(tmp_path)
        (tmp_path / names[1]).unlink()
        with pytest.raises(InputError, match="has no header"):
            load_rssi(tmp_path / names[0])


@pytest.mark.parametrize("layout", ["raw", "receiver moves"])
def test_other_nerf2_layouts(table, tmp_path, layout):
    place, lines = (
        RECEIVER.set_index("receiver"),
        ["x, y, z", *(f"{x},{y},1.1" for x, y in table[["x", "y"]].to_numpy())],
    )
    if layout == "raw":
        files = {"beacon_pos.csv": "\n".join(lines), "gateway_pos.csv": text(place), "rssi.csv": text(table[NAMES])}
    else:
        yml = "\n".join(f"{name}: {list(at)}" for name, at in zip(NAMES, place.to_numpy().tolist(), strict=True))
        files = {"rx_pos.csv": "\n".join(lines), "gateway_position.yml": yml, "gateway_rssi.csv": text(table[NAMES])}
    data = read(files, tmp_path)
    is_read_as(data, table)
    np.testing.assert_allclose(data.receiver_position, place)
    assert noted(data, "the receiver moves") == (layout == "receiver moves")


def test_uji_and_sod_indoor_loc():
    uji = pd.DataFrame({"WAP001": range(-80, -68), "WAP002": 100, "WAP003": [-90, 100] * 6})
    uji = uji.assign(LONGITUDE=-7541.2 + uji.index, LATITUDE=4864921.0 + uji.index, FLOOR=uji.index % 3)
    data = Rssi.from_frame(uji.assign(BUILDINGID=1, SPACEID=106, USERID=2, TIMESTAMP=1371713733))
    assert data.receiver_names == ("WAP001", "WAP003")
    assert data.transmitter_position[2].tolist() == [-7539.2, 4864923.0, 8.0]
    assert data.rssi_dbm[1].isnan().tolist() == [False, True]
    notes = " ".join(data.notes)
    for words in (
        "never detected the transmitter are left out: 1",
        "BUILDINGID, SPACEID, USERID",
        "FLOOR counts as 4 m",
    ):
        assert words in notes
    sod = silenced(WALK, -105.0).rename(
        columns={name: f"MAC{i}" for i, name in enumerate(NAMES, 1)} | {"x": "ECoord", "y": "NCoord"}
    )
    data = Rssi.from_frame(sod.assign(FloorID=3, BuildingID=1, UserID=2, PhoneID=3, SampleTimes=10))
    is_read_as(data, silenced(WALK), ["MAC1", "MAC2", "MAC3", "MAC4"])
    assert float(data.transmitter_position[0, 2]) == 12


def test_a_wardriving_log(table, tmp_path):
    """A line of metadata, one packet a row, degrees, rows without a fix and names with commas."""
    lost = np.isin(np.arange(N), [4, 17, 40])
    degrees = np.where(lost[:, None], 0, GeodeticOrigin(-22.9, -43.2).to_degrees(table[["x", "y"]].to_numpy()))
    lines = ["WigleWifi-1.4,appRelease=2.80,model=Phone,release=13,device=phone,display=x,board=y,brand=z"]
    lines += [
        "MAC,SSID,AuthMode,FirstSeen,Channel,RSSI,CurrentLatitude,CurrentLongitude,AltitudeMeters,AccuracyMeters,Type"
    ]
    for i, (latitude, longitude) in enumerate(degrees):
        place = f"{latitude:.8f},{longitude:.8f},{0 if lost[i] else 12.5},4"
        for name in NAMES:
            lines.append(f'{name},"cafe, wifi",[WPA2],2026-04-02 08:00:{i:02},6,{table[name][i]:.0f},{place},WIFI')
    data = read("\r\n".join(lines), tmp_path)
    is_read_as(data, table[~lost], atol=0.01)
    assert float(data.transmitter_position[0, 2]) == 12.5
    assert noted(data, "lines before the header are skipped: 1")


@pytest.mark.data
@pytest.mark.parametrize("name", ["kolak", "lora-campus", "tetam-tracks", "tetam-fingerprints", "dcm-rssi"])
def test_measured_tables_are_read_without_options(measured_data, name):
    data = load_rssi(measured_data / name)
    fillers = [note for note in data.notes if "not detected" in note]
    assert all(note.startswith("-100 ") for note in fillers)
    assert data.located


# refusals


def beside(places: str) -> dict[str, str]:
    return {"walk.csv": text(WALK), "receivers.csv": places}


NAMED_X = {"x": "easting_of_robot"}
EASTING = WALK.rename(columns={"x": "easting_of_robot"})
REFUSED = [
    ("no column for x", "a,b\n-50,-60", {}),
    (r"no column for x.*x=NAME", EASTING, {}),
    ("no column 'nowhere' for y", EASTING, {"columns": NAMED_X | {"y": "nowhere"}}),
    ("columns takes x, y, z, .*, session, receiver, rssi, got 'w'", EASTING, {"columns": {"w": "y"}}),
    ("no column 'nowhere' for offsets", WALK, {"offset_by": "nowhere"}),
    ("no column of RSSI", "x,y,speed\n1,2,3", {}),
    ("numbers below 0", "x,y,a\n1,2,45\n1,2,90", {}),
    ("no RSSI beside", "x,y,receiver\n1,2,a", {}),
    ("may be x", "x,pos_x,y,a\n1,1,2,-50", {}),
    ("--coordinates degrees or --coordinates metres", AMBIGUOUS(WALK), {}),
    ("may be degrees or metres", AMBIGUOUS(WALK.assign(x=np.where(np.arange(N) % 3, WALK.x, -170.0))), {}),
    ("may be degrees or metres", WALK.assign(x=23.7 + WALK.x / 100, y=61.5 + WALK.y / 100), {}),
    *(
        ("values beyond 180 degrees; if they are metres, give --coordinates metres", FAR(WALK), {"coordinates": asked})
        for asked in (None, "degrees")
    ),
    ("are they swapped", "lat,lon,a\n111.5,48.1,-50", {}),
    ("are in pixels; give --scale PIXELS_PER_METRE", on_plan(8.0)(WALK), {}),
    ("'here' is not a number", "x,y,a\nhere,2,-50", {}),
    ("'loud' is not a number", "x,y,a\n1,2,-50\n1,2,-51\n1,2,loud", {}),
    ("without a position are left out: 2 of 2", "x,y,a\n,2,-50\n1,,-50", {}),
    ("at most 1e", "x,y,a\n1e12,2,-50", {}),
    ("row 3, receiver a: 31 dBm", "x,y,a\n1,2,-50\n1,2,-50\n1,2,31", {}),
    ("row 3, receiver a: 31 dBm", "x,y,receiver,rssi\n1,2,a,-50\n1,2,b,-50\n2,2,a,31", {}),
    ("row 2 has no receiver in column receiver", "x,y,receiver,rssi\n1,2,a,-50\n1,2,,-50", {}),
    ("no RSSI that a receiver detected", "x,y,a\n1,2,-100", {}),
    ("row 1 has 2 values, but the header has 3", "x,y,a\n1,2\n", {}),
    ("no rows", "x,y,a\n", {}),
    ("2 tables", {"walk.csv": text(WALK), "b.csv": text(WALK)}, {}),
    ("'a' twice", "x,y,a,a\n1,2,-50,-60", {}),
    ("not a Parquet file", {"walk.parquet": "PAR1"}, {}),
    ("must have each receiver once", beside("receiver,x,y,z\na,1,2,3\na,1,2,3"), {}),
    ("has no column of times", long_of(WALK, "anchor").drop(columns="t"), {"window": 1.0}),
]


@pytest.mark.parametrize(("words", "content", "options"), REFUSED)
def test_refuses(tmp_path, words, content, options):
    with pytest.raises(InputError, match=words):
        read(content, tmp_path, **options)


def test_positions_without_a_known_header_are_refused_with_all_that_are_known(tmp_path):
    (tmp_path / "places.csv").write_text("width,depth\n1,2\n")
    with pytest.raises(InputError, match="no columns of positions, x and y or longitude and latitude; there are width"):
        read_places(tmp_path / "places.csv", None, PlanFrame())


def test_positions_of_other_receivers_beside_a_table_are_a_note_and_stated_ones_a_refusal(tmp_path):
    (tmp_path / "walk.csv").write_text(text(WALK))
    (tmp_path / "receivers.csv").write_text("receiver,x,y,z\nelsewhere,1,2,3\n")
    data = load_rssi(tmp_path)
    assert not data.located
    assert any("receivers.csv is not used: it has none of the receivers" in note for note in data.notes)
    with pytest.raises(InputError, match="has none of the receivers"):
        load_rssi(tmp_path, receiver_positions=tmp_path / "receivers.csv")
    name = data.receiver_names[0]
    (tmp_path / "own.csv").write_text(f"receiver,x,y,z\n{name},4,5,6\n")
    chosen = load_rssi(tmp_path / "walk.csv", receiver_positions=tmp_path / "own.csv")
    assert chosen.receiver_position[0].tolist() == [4.0, 5.0, 6.0]
    assert "own.csv" in chosen.source


@pytest.mark.parametrize(
    ("unit", "cells", "dbm"),
    [("percent", [80, 41, 100], [-60.0, -79.5, -50.0]), ("positive", [61, 79, 88], [-61.0, -79.0, -88.0])],
)
@pytest.mark.parametrize("suffix", ["", "%"])
def test_rssi_in_percent_or_without_sign_is_converted_where_its_unit_is_stated(tmp_path, unit, cells, dbm, suffix):
    (tmp_path / "long.csv").write_text(
        "x,y,ap,rssi\n" + "".join(f"{k},{k},a,{v}{suffix}\n" for k, v in enumerate(cells))
    )
    (tmp_path / "wide.csv").write_text("x,y,AP1\n" + "".join(f"{k},{k},{v}{suffix}\n" for k, v in enumerate(cells)))
    assert load_rssi(tmp_path / "long.csv", unit=unit).rssi_dbm[:, 0].tolist() == dbm
    assert load_rssi(tmp_path / "wide.csv", unit=unit, columns={"rssi": "AP*"}).rssi_dbm[:, 0].tolist() == dbm
    for name, words in (("long", "give unit positive.* unit percent"), ("wide", "give unit percent or positive")):
        with pytest.raises(InputError, match=words):
            load_rssi(tmp_path / f"{name}.csv")
    with pytest.raises(InputError, match="choose with columns rssi=NAME"):
        load_rssi(tmp_path / "wide.csv", unit=unit)


@pytest.mark.parametrize(
    ("name", "values", "heights"),
    [
        ("Level", [1, 2], {4.0, 8.0}),
        ("building_level", ["Ground", "Level 2"], {0.0, 8.0}),
        ("level", ["EG", "1.OG"], {0.0, 4.0}),
    ],
)
def test_levels_with_a_known_order_are_floors(name, values, heights):
    walk = pd.DataFrame({"x": range(12), "y": 0.0, "ap": -50.0, name: values * 6})
    data = Rssi.from_frame(walk)
    assert {*data.transmitter_position[:, 2].tolist()} == heights
    assert f"floor = {name}" in data.notes[0]


@pytest.mark.parametrize(
    ("name", "values"), [("Map", ["1", "2"]), ("FloorPlan", ["west", "east"]), ("Level", ["red", "blue"])]
)
def test_maps_and_levels_without_order_are_asked_about(name, values):
    walk = pd.DataFrame({"x": range(12), "y": 0.0, "ap": -50.0, name: values * 6})
    with pytest.raises(InputError, match=f"is '{name}' .* the floor of each row"):
        Rssi.from_frame(walk)
    assert len(Rssi.from_frame(walk, offset_by=name)) == 12
    one = Rssi.from_frame(walk.assign(**{name: values[0]}))
    assert len(one) == 12
