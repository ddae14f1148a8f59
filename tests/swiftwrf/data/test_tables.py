"""Tables of RSSI as other tools write them: one walk in many shapes, units and words, which is read the same each time."""

import numpy as np
import pandas as pd
import pytest
from test_rssi_kinds import noted

from swiftwrf import InputError, Rssi, load_rssi
from swiftwrf.data.coordinates import GeodeticOrigin

N = 60
ADDRESSES = ["0d:1c:19:95:43:33", "cb:99:d5:23:7d:12", "f9:f7:ba:a0:48:d6", "1d:3e:04:f1:ce:23"]


def walk(seed: int) -> pd.DataFrame:
    """A walk with RSSI of four receivers in whole decibels: x, y, a, b, c, d."""
    draw = np.random.default_rng(seed)
    xy = np.column_stack([np.linspace(0.5, 23, N), draw.uniform(0.4, 11, N)]).round(2)
    away = np.linalg.norm(xy[:, None] - draw.uniform((0, 0), (24, 12), (4, 2)), axis=2)
    rssi = (-42 - 24 * np.log10(1 + away) + draw.normal(0, 2, (N, 4))).round()
    return pd.DataFrame(np.column_stack([xy, rssi]), columns=["x", "y", "a", "b", "c", "d"])


@pytest.fixture
def table():
    return walk(2)


def is_read_as(data: Rssi, table: pd.DataFrame, names=("a", "b", "c", "d"), atol=1e-6) -> None:
    """Assert that the data are those of the walk, up to the order of receivers and the origin of the metres."""
    assert sorted(data.receiver_names) == sorted(names)
    rssi = data.rssi_dbm[:, [data.receiver_names.index(name) for name in names]]
    np.testing.assert_array_equal(rssi, table[["a", "b", "c", "d"]])
    position = data.transmitter_position[:, :2] - data.transmitter_position[0, :2]
    np.testing.assert_allclose(position, table[["x", "y"]] - table[["x", "y"]].iloc[0], atol=atol)


def long_of(table: pd.DataFrame, receiver: str, rssi: str) -> pd.DataFrame:
    """The table with a row a packet, packets of a place below each other."""
    packets = table.reset_index(names="t").melt(["t", "x", "y"], var_name=receiver, value_name=rssi)
    return packets.sort_values("t", kind="stable")


QUANTITIES = {
    "cellular": ["RSRQ [dB]", "SINR", "rssnr", "CQI"],
    "radio": ["SNR", "noise_floor", "TxPower", "tx_pwr_dbm"],
    "sensors": ["mag_x", "magY", "accZ", "gyro_z", "roll", "Pitch", "heading", "temperature"],
    "estimates": ["x_est", "est_y", "odom_x", "y_hat", "x_pred"],
    "unknown": ["drift"],
}


@pytest.mark.parametrize("kind", QUANTITIES)
def test_other_quantities_are_no_receivers(table, kind):
    draw = np.random.default_rng(1)
    other = {name: draw.normal(-20, 6, N).round(1) for name in QUANTITIES[kind]}
    data = Rssi.from_frame(table.assign(**other))
    is_read_as(data, table)
    assert noted(data, "left out", *other)
    assert data.notes[0] == "taken as: x = x, y = y, RSSI of 4 receivers = a, b, c, d"
    named = Rssi.from_frame(table.assign(**other), columns={"rssi": next(iter(other))})
    assert named.receiver_names == (next(iter(other)),)


@pytest.mark.parametrize("name", ["RSRP", "rssi", "RSS [dBm]", "Signal Strength", "level"])
def test_one_quantity_is_the_received_power(table, name):
    cell = table[["x", "y", "a"]].rename(columns={"a": name}).assign(PCI=7, RSRQ=-11.5, SNR=table.b / 10)
    assert Rssi.from_frame(cell).receiver_names == (name,)
    data = Rssi.from_frame(cell.assign(cell_id=["17", "18"] * (N // 2), RSRP=cell[name]).drop(columns="PCI"))
    assert data.receiver_names == ("17", "18")


def test_a_receiver_that_is_named_unlike_the_others_is_pointed_out(table):
    data = Rssi.from_frame(table.set_axis(["x", "y", "AP1", "AP2", "AP3", "hx"], axis=1))
    assert len(data.receiver_names) == 4
    assert noted(data, "named unlike the others: hx")


def written(power, metres="{} m"):
    """Return a change of a table that writes its numbers as text."""
    return lambda t: t[["x", "y"]].map(metres.format).join(t[["a", "b", "c", "d"]].map(power))


def scaled(unit, factor):
    """Return a change of a table to lengths in another unit."""
    return lambda t: t.assign(x=factor * t.x, y=factor * t.y).rename(columns={"x": f"x_{unit}", "y": f"y [{unit}]"})


def with_letters(table):
    degrees = GeodeticOrigin(-33.9, -70.2).to_degrees(table[["x", "y"]].to_numpy())
    text = {"Lat": [f"{-value:.8f} S" for value in degrees[:, 0]], "Lon": [f"{-v:.8f}\u00b0W" for v in degrees[:, 1]]}
    return table.assign(**text).drop(columns=["x", "y"])


def called_latitude(table):
    return table.assign(longitude=table.x - 7541.26, latitude=table.y + 4864921.5).drop(columns=["x", "y"])


RECEIVERS = [
    *("gateway_id", "gateway", "gw", "ap", "ap_name", "AP Name", "ap_mac", "mac_address", "MAC", "beacon_id", "anchor"),
    *("sensor", "node", "station", "access_point", "rx_id", "ssid", "BSSID", "cell_id", "pci", "eui", "beacon"),
]
FORMS = {  # the change of the table, and words of a note
    "units": (written(lambda v: f"{v:.0f} dBm"), ""),
    "units without space": (written(lambda v: f"{v:.1f}dBm"), ""),
    "typographic minus": (written(lambda v: f"\u2212{-v:.0f}"), ""),
    "dash for minus": (written(lambda v: f"\u2013{-v:.0f}"), ""),
    "centimetres": (scaled("cm", 100.0), "cm in a metre"),
    "millimetres": (scaled("mm", 1000.0), "mm in a metre"),
    "feet": (scaled("ft", 1 / 0.3048), "ft in a metre"),
    "degrees with letters": (with_letters, ""),
    "metres that are called latitude": (called_latitude, ""),
    **{
        f"receivers in a column {name}": (
            lambda t, name=name: long_of(t, name, "rssi").assign(snr=-3.5, device="phone"),
            "",
        )
        for name in RECEIVERS
    },
}


@pytest.mark.parametrize("form", FORMS)
def test_a_walk_in_any_form_is_read_the_same(table, form):
    change, words = FORMS[form]
    data = Rssi.from_frame(change(table))
    is_read_as(data, table, atol=0.01 if "degrees" in form else 1e-6)
    assert not words or noted(data, words)


@pytest.mark.parametrize("name", ["hotspot", "Netzwerk", "peer"])
@pytest.mark.parametrize("moving", [False, True])
def test_a_column_that_may_be_the_receiver_is_asked_about(table, name, moving):
    packets = long_of(table, name, "rssi")
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


@pytest.mark.parametrize(
    "word", ["--", "---", "n/a", "N.D.", "not heard", "Not detected", "no signal", "", "*", "lost"]
)
def test_words_for_not_detected(table, word):
    silent = np.random.default_rng(0).random((N, 4)) < 0.3
    text = table.astype(str)
    text[["a", "b", "c", "d"]] = text[["a", "b", "c", "d"]].mask(silent, word)
    data = Rssi.from_frame(text)
    np.testing.assert_array_equal(data.detected, ~silent)
    assert noted(data, "'lost' counts as not detected") == (word == "lost")
    text.loc[3, "a"], text.loc[4, "b"] = "lost", "loud"
    with pytest.raises(InputError, match="is not a number"):
        Rssi.from_frame(text)


def text_of(table: pd.DataFrame) -> list[str]:
    return table.to_csv(index=False).splitlines()


SHAPES = {
    "header repeated": lambda lines: [*lines[:20], lines[0], *lines[20:40], lines[0], *lines[40:]],
    "hash before the header": lambda lines: [f"# {lines[0]}", *lines[1:]],
    "last columns without cells": lambda lines: [f"{lines[0]},remark,tag", *lines[1:]],
    "separators at the end": lambda lines: [lines[0], *(f"{line},," for line in lines[1:])],
    "columns without content": lambda lines: [f"{line},," for line in lines],
    "rows without content": lambda lines: [*lines, ",,,,,", ",,,,,"],
    "index of a data frame": lambda lines: [f",{lines[0]}", *(f"{row},{line}" for row, line in enumerate(lines[1:]))],
    "second header": lambda lines: [lines[0], ",,HomeNet,HomeNet_5G,Guest,Printer", *lines[1:]],
    "row of units": lambda lines: [lines[0], "m,m,dBm,dBm,dBm,dBm", *lines[1:]],
    "lines above": lambda lines: ["Survey export", "Project: office, 2nd floor", "", *lines],
}


@pytest.mark.parametrize("shape", SHAPES)
def test_shapes_of_tables(table, shape, tmp_path):
    (tmp_path / "walk.csv").write_text("\n".join(SHAPES[shape](text_of(table))))
    data = load_rssi(tmp_path / "walk.csv")
    is_read_as(data, table)
    silent = ("separators at the end", "columns without content", "rows without content", "index of a data frame")
    assert (len(data.notes) > 2) != (shape in (*silent, "hash before the header"))


def test_rows_of_different_lengths_are_refused(table, tmp_path):
    lines = text_of(table)
    (tmp_path / "walk.csv").write_text("\n".join([*lines[:5], lines[5].rsplit(",", 1)[0], *lines[6:]]))
    with pytest.raises(InputError, match="row 5 has 5 values, but the header has 6"):
        load_rssi(tmp_path / "walk.csv")


@pytest.mark.parametrize(
    "names", [("trn01rss.csv", "trn01crd.csv"), ("Training_rss_21Aug.csv", "Training_coordinates_21Aug.csv")]
)
@pytest.mark.parametrize("header", [False, True])
def test_rssi_and_coordinates_in_two_files(table, tmp_path, names, header):
    rssi = table[["a", "b", "c", "d"]].mask(table[["a", "b", "c", "d"]] < -75, 100)
    rssi.astype(int).to_csv(tmp_path / names[0], index=False, header=header)
    table[["x", "y"]].sub([40, 30]).assign(z=3.5).to_csv(tmp_path / names[1], index=False, header=header)  # negative
    data = load_rssi(tmp_path)
    named = ("a", "b", "c", "d") if header else tuple(f"receiver{i}" for i in range(1, 5))
    is_read_as(data, table.mask(table < -75), named)
    assert float(data.transmitter_position[0, 2]) == 3.5
    assert set(data.source) == set(names)
    if header:
        return
    table[["x"]].to_csv(tmp_path / "trn01tms.csv", index=False, header=False)
    assert len(load_rssi(tmp_path / names[0])) == N
    with pytest.raises(InputError, match="holds 3 tables"):
        load_rssi(tmp_path)
    (tmp_path / names[1]).unlink()
    with pytest.raises(InputError, match="has no header"):
        load_rssi(tmp_path / names[0])


@pytest.mark.parametrize("scale", [20.7, 8.0])
@pytest.mark.parametrize("above", ["Scale: 1 m = {} px", "{} px/m", "pixels per meter: {}", None])
def test_pixels_of_a_floor_plan(table, tmp_path, scale, above):
    plan = pd.DataFrame({"Map X (px)": scale * table.x, "Map Y (px)": scale * (12 - table.y)}).join(table.iloc[:, 2:])
    lines = ["Survey export", above.format(scale), ""] if above else []
    (tmp_path / "walk.csv").write_text("\n".join([*lines, *text_of(plan)]))
    if above is None:
        with pytest.raises(InputError, match="are in pixels; give --scale PIXELS_PER_METRE"):
            load_rssi(tmp_path / "walk.csv")
    data = load_rssi(tmp_path / "walk.csv", scale=None if above else scale)
    is_read_as(data, table)
    assert data.plan_scale == scale
    plain = plan.rename(columns={"Map X (px)": "x", "Map Y (px)": "y"})
    is_read_as(Rssi.from_frame(plain, scale=scale, y_down=True), table)


def test_y_that_points_up(table, tmp_path):
    """Receivers beside the table have its axes."""
    phone = table.assign(z=-table.y, y=0.1 * np.sin(table.x))[["x", "y", "z", "a", "b", "c", "d"]]
    phone.to_csv(tmp_path / "walk.csv", index=False)
    (tmp_path / "receivers.csv").write_text("receiver,x,y,z\na,3,1.4,-2\n")
    assert noted(load_rssi(tmp_path / "walk.csv"), "if y is the height, give --up y")
    data = load_rssi(tmp_path / "walk.csv", up="y")
    is_read_as(data, table)
    assert data.receiver_position[0].tolist() == [3, 2, 1.4]


@pytest.mark.parametrize("unit", ["1e7", "ddmm"])
@pytest.mark.parametrize("at", [(47.4, 8.5), (-33.9, 151.2), (52.5, -1.4)])
def test_degrees_in_other_units(table, unit, at):
    degrees = GeodeticOrigin(*at).to_degrees(table[["x", "y"]].to_numpy())
    if unit == "1e7":
        values = np.round(1e7 * degrees).astype(int)
    else:
        size = np.abs(degrees)
        values = np.sign(degrees) * (100 * np.floor(size) + 60 * (size % 1)).round(7)
    data = Rssi.from_frame(table.assign(latitude=values[:, 0], longitude=values[:, 1]).drop(columns=["x", "y"]))
    is_read_as(data, table, atol=0.03)
    assert noted(data, "converted to degrees")
    assert noted(data, "longitude longitude and latitude latitude are projected")


@pytest.mark.parametrize("longitude", [-74.1, 179.9999, -179.9999])
@pytest.mark.parametrize("named", [True, False])
def test_longitudes_from_0_to_360_degrees(table, longitude, named):
    degrees = GeodeticOrigin(40.7, longitude).to_degrees(table[["x", "y"]].to_numpy())
    names = ["longitude", "latitude"] if named else ["x", "y"]
    changed = table.drop(columns=["x", "y"]).assign(**{names[0]: degrees[:, 1] % 360, names[1]: degrees[:, 0]})
    data = Rssi.from_frame(changed, coordinates=None if named else "degrees")
    is_read_as(data, table, atol=1e-3)
    assert noted(data, "count from 0 to 360 degrees")


def test_receivers_with_longitudes_from_0_to_360_degrees(table, tmp_path):
    origin = GeodeticOrigin(40.7, -74.1)
    degrees = origin.to_degrees(table[["x", "y"]].to_numpy())
    table.assign(longitude=degrees[:, 1], latitude=degrees[:, 0]).drop(columns=["x", "y"]).to_csv(
        tmp_path / "walk.csv", index=False
    )
    (tmp_path / "receivers.csv").write_text(f"receiver,longitude,latitude\na,{degrees[3, 1] % 360},{degrees[3, 0]}\n")
    data = load_rssi(tmp_path / "walk.csv")
    np.testing.assert_allclose(data.receiver_position[0, :2], data.transmitter_position[3, :2], atol=1e-3)
    table.to_csv(tmp_path / "walk.csv", index=False)
    with pytest.raises(InputError, match="holds longitudes and latitudes, but the measurements are in metres"):
        load_rssi(tmp_path / "walk.csv")


def test_columns_named_as_degrees_are_metres_only_if_none_can_be_degrees(table):
    named = table.rename(columns={"x": "longitude", "y": "latitude"})
    with pytest.raises(InputError, match="may be degrees or metres"):
        Rssi.from_frame(named.assign(longitude=np.where(np.arange(N) % 3, named.longitude, -170.0)))
    beyond = named.assign(longitude=named.longitude + 361.1)
    for asked in (None, "degrees"):
        with pytest.raises(
            InputError, match="values beyond 180 degrees; if they are metres, give --coordinates metres"
        ):
            Rssi.from_frame(beyond, coordinates=asked)
    is_read_as(Rssi.from_frame(beyond, coordinates="metres"), table)
    projected = named.assign(longitude=named.longitude + 691_000, latitude=named.latitude + 5_300_000)
    is_read_as(Rssi.from_frame(projected), table)
    assert noted(Rssi.from_frame(projected), "count as metres, because none of their values can be degrees")


def test_one_row_of_a_stream_keeps_its_receivers(table):
    row = table.iloc[:1].assign(a=-11.5, noise=-95)
    assert Rssi.from_frame(row).receiver_names == ("a", "b", "c", "d")


START = pd.Timestamp("2024-03-09 16:00:00", tz="UTC")
TIMES = {
    "seconds": lambda s: s,
    "epoch": lambda s: START.timestamp() + s,
    "milliseconds": lambda s: (1000 * (START.timestamp() + s)).astype("int64"),
    "microseconds": lambda s: (1e6 * (START.timestamp() + s)).astype("int64"),
    "nanoseconds": lambda s: [(START + pd.Timedelta(seconds=v)).value for v in s],
    "14 digits": lambda s: [f"{START + pd.Timedelta(seconds=v):%Y%m%d%H%M%S}" for v in s],
    "17 digits": lambda s: [f"{START + pd.Timedelta(seconds=v):%Y%m%d%H%M%S}000" for v in s],
    "dates": lambda s: [f"{START + pd.Timedelta(seconds=v):%Y-%m-%dT%H:%M:%SZ}" for v in s],
    "dates with the day first": lambda s: [f"{START + pd.Timedelta(seconds=v):%d.%m.%Y %H:%M:%S}" for v in s],
    "milliseconds from a start": lambda s: (1000 * s).astype(int),
}


@pytest.mark.parametrize("kind", TIMES)
def test_times_in_other_units(table, kind):
    seconds = (
        3.0 * np.arange(N) if "start" not in kind else np.cumsum(np.random.default_rng(0).uniform(4, 6, N)).round(3)
    )
    name = "time_ms" if "start" in kind else "timestamp"
    data = Rssi.from_frame(table.assign(**{name: TIMES[kind](seconds)}))
    assert noted(data, kind) == (kind in ("milliseconds", "microseconds", "nanoseconds"))
    first = seconds[0] if "start" in kind or kind == "epoch" else 0
    np.testing.assert_allclose(data.time, seconds - first, atol=1e-3)


def test_times_that_are_read_otherwise_have_a_note(table):
    odd = table.assign(time=["noon" if n % 10 == 3 else f"{n}" for n in range(N)])
    data = Rssi.from_frame(odd)
    assert data.time.isnan().nonzero()[:, 0].tolist() == list(range(3, N, 10))
    assert noted(data, "cells of column time that hold no time are unknown: 6 of 60, e.g. 'noon'")
    clock = [f"{pd.Timestamp('2024-01-01 23:59:30') + pd.Timedelta(seconds=n):%H:%M:%S}" for n in range(N)]
    night = Rssi.from_frame(table.assign(time=clock))
    np.testing.assert_array_equal(night.time, np.arange(N))
    assert noted(night, "pass midnight")


@pytest.mark.parametrize("kind", ["decimal comma", "durations"])
def test_times_with_a_decimal_comma_or_as_durations(table, kind):
    half = np.arange(N) / 2
    time = pd.to_timedelta(half, unit="s") if kind == "durations" else [f"{t:.1f}".replace(".", ",") for t in half]
    np.testing.assert_allclose(Rssi.from_frame(table.assign(time=time)).time, half, atol=1e-9)


def test_date_and_time_in_two_columns(table):
    moment = START + pd.to_timedelta(3600.0 * np.arange(N), unit="s")  # over midnights
    parts = table.assign(Date=moment.strftime("%d.%m.%Y"), Time=moment.strftime("%H:%M:%S"))
    data = Rssi.from_frame(parts)
    np.testing.assert_array_equal(data.time, 3600.0 * np.arange(N))
    assert noted(data, "Date and Time together are the time")


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
    apart = Rssi.from_frame(log)
    assert noted(apart, "--window 1")
    data = Rssi.from_frame(log, window=cycle)
    assert noted(data, "400 rows are joined to 100", f"windows of {cycle:g} s")
    assert bool(data.detected.all())
    for name in data.receiver_names:
        mine = log.rssi[log.anchor == name]
        np.testing.assert_array_equal(data.rssi_dbm[:, data.receiver_names.index(name)], mine)
    np.testing.assert_allclose(data.transmitter_position[0, :2], log[["x", "y"]][:4].mean(), atol=1e-9)
    with pytest.raises(InputError, match="has no column of times"):
        Rssi.from_frame(log.drop(columns="timestamp"), window=cycle)


@pytest.mark.parametrize("every", [2, 4])
def test_scans_that_are_repeated_at_other_places(table, tmp_path, every):
    stale = table.copy()
    stale[["a", "b", "c", "d"]] = table[["a", "b", "c", "d"]].iloc[np.arange(N) // every * every].to_numpy()
    data = Rssi.from_frame(stale)
    np.testing.assert_array_equal(data.index, np.arange(0, N, every))
    assert noted(data, "cached scans", f"{N - len(data)} of {N}")
    stale.to_csv(tmp_path / "walk.csv", index=False)
    for part, rows in (("train", range(40)), ("test", range(40, N))):
        (tmp_path / f"{part}_index.txt").write_text("\n".join(map(str, rows)))
    assert len(load_rssi(tmp_path)) == N  # a published split stays as it is
    same = stale.assign(x=1.0, y=2.0)
    assert len(Rssi.from_frame(same)) == N  # measured again at one place
    assert len(Rssi.from_frame(table)) == N


@pytest.mark.parametrize("highest", [-64, -67])
def test_the_upper_end_of_the_scale_is_named(table, highest):
    data = Rssi.from_frame(table.clip(upper=table.where(table > 0, highest)))
    count = int((data.rssi_dbm == highest).sum())
    assert noted(data, f"the scale ends at {highest} dBm", f"{count} of {4 * N} cells")
    assert not noted(Rssi.from_frame(table), "the scale ends")


SPELLINGS = {
    "capitals": str.upper,
    "dashes": lambda name: name.replace(":", "-"),
    "no separators": lambda name: name.replace(":", "").upper(),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("n", [2, 4])
def test_names_of_receivers_in_another_spelling(table, tmp_path, spelling, n):
    table.set_axis(["x", "y", *ADDRESSES], axis=1).to_csv(tmp_path / "walk.csv", index=False)
    names = [*map(SPELLINGS[spelling], ADDRESSES[:n]), *ADDRESSES[n:]]
    lines = [f"{name},{number},2,3" for number, name in enumerate(names)]
    (tmp_path / "receivers.csv").write_text("\n".join(["receiver,x,y,z", *lines]))
    data = load_rssi(tmp_path / "walk.csv")
    assert data.receiver_position[:, 0].tolist() == [0, 1, 2, 3]
    assert noted(data, "spelled differently", f"{names[0]} is {ADDRESSES[0]}")
    two_phones = pd.concat([table.set_axis(["x", "y", *ADDRESSES], axis=1), table.set_axis(["x", "y", *names], axis=1)])
    long = two_phones.melt(["x", "y"], var_name="bssid", value_name="rssi").dropna()
    assert set(Rssi.from_frame(long).receiver_names) == set(ADDRESSES)


def test_zeros_before_numbers_of_receivers(table, tmp_path):
    table.set_axis(["x", "y", "1", "2", "10", "11"], axis=1).to_csv(tmp_path / "walk.csv", index=False)
    (tmp_path / "receivers.csv").write_text("receiver,x,y,z\n01,1,2,3\n02,2,2,3\n010,10,2,3\n11,11,2,3\n")
    assert load_rssi(tmp_path / "walk.csv").receiver_position[:, 0].tolist() == [1, 2, 10, 11]
