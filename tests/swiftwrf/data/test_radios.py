"""Names of receivers that are not those of radios: ranked lists, unknown ids, several radios of a name, rooms, powers."""

import numpy as np
import pandas as pd
import pytest
from samples import walk

from swiftwrf import InputError, Rssi

RADIOS = ["a4:56:cc:00:10:b0", "b4:56:cc:00:11:b0", "c4:56:cc:00:12:b0", "d4:56:cc:00:13:b0"]
WALK = walk()
N = len(WALK)
POWER = WALK[["a", "b", "c", "d"]].to_numpy()  # [dBm]
PLACE = WALK[["x", "y"]].assign(time=range(N))


def ranked(name: str, value: str, number: int, names=RADIOS, **others: object) -> pd.DataFrame:
    """Return the walk as lists of the strongest receivers; {} in the names of columns is the rank."""
    order, columns = np.argsort(-POWER, axis=1), {}
    for rank in range(number):
        columns[name.format(rank + 1)] = np.array(names)[order[:, rank]]
        columns[value.format(rank + 1)] = np.take_along_axis(POWER, order, 1)[:, rank]
        columns |= {column.format(rank + 1): values for column, values in others.items()}
    return PLACE.assign(**columns)


def same_values(data: Rssi, names=RADIOS, power=POWER, number: int = 4) -> None:
    """Assert that the data are the strongest `number` values of each row of the walk."""
    assert sorted(data.receiver_names) == sorted(names)
    listed = np.where(np.argsort(np.argsort(-power, axis=1), axis=1) < number, power, np.nan)
    columns = [data.receiver_names.index(name) for name in names]
    np.testing.assert_allclose(data.rssi_dbm[:, columns], listed, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("ap{}_bssid", "ap{}_rssi"),
        ("bssid_{}", "level_{}"),
        ("Network {} Name", "Network {} RSSI [dBm]"),
        ("mac{}", "rssi{}"),
    ],
)
def test_numbered_columns_of_names_and_powers_are_lists(name, value):
    data = Rssi.from_frame(ranked(name, value, 3, **{"ap{}_channel": 6}))
    same_values(data, number=3)
    assert data.margin_db == 0.0
    assert any("numbered columns are lists" in note for note in data.notes)


def test_the_serving_cell_is_the_first_of_the_numbered_neighbours():
    cells = ["117", "302", "411", "5"]
    table = ranked("ncell{}_pci", "ncell{}_rsrp", 3, names=cells)
    table = table.rename(columns={"ncell1_pci": "pci", "ncell1_rsrp": "rsrp"})
    same_values(Rssi.from_frame(table), names=cells, number=3)


def test_numbered_receivers_without_names_are_those_of_their_columns():
    table = PLACE.assign(**{f"ap{c + 1}_rssi": POWER[:, c] for c in range(4)}, ap1_channel=1, ap2_channel=6)
    assert Rssi.from_frame(table).receiver_names == ("ap1_rssi", "ap2_rssi", "ap3_rssi", "ap4_rssi")


def test_two_lists_at_one_place_stay_apart():
    table = ranked("ap{}_bssid", "ap{}_rssi", 4).drop(columns="time").assign(x=1.0, y=2.0)
    same_values(Rssi.from_frame(table))


def packets(**columns: object) -> pd.DataFrame:
    """Return the walk with a row a packet, and columns by receiver (4,) or packet (n, 4)."""
    table = pd.concat([PLACE] * 4, ignore_index=True).assign(rsrp=POWER.T.ravel())
    each = {
        name: np.broadcast_to(np.asarray(values, dtype=object), (N, 4)).T.ravel() for name, values in columns.items()
    }
    return table.assign(**each)


@pytest.mark.parametrize(("identity", "unknown"), [("eci", 0), ("cell_id", 2147483647), ("cid", -1)])
def test_neighbours_without_a_cell_id_are_known_by_their_physical_cell(identity, unknown):
    serving = POWER.max(axis=1, keepdims=True) == POWER
    table = packets(**{identity: np.where(serving, [801, 802, 803, 804], unknown)}, pci=[0, 87, 99, 335])
    same_values(Rssi.from_frame(table), names=["0", "87", "99", "335"])


def test_packets_of_an_unknown_id_are_left_out():
    broken = np.arange(N)[:, None] % 20 == np.arange(4)
    data = Rssi.from_frame(packets(bssid=np.where(broken, "00:00:00:00:00:00", RADIOS)))
    same_values(data, power=np.where(broken, np.nan, POWER))
    assert any("00:00:00:00:00:00 in column bssid" in note and f": {broken.sum()}" in note for note in data.notes)


def test_physical_cells_repeat_on_other_carriers():
    data = Rssi.from_frame(packets(pci=[117, 302, 117, 302], earfcn=[6300, 6300, 1300, 1300]))
    same_values(data, names=["117 6300", "302 6300", "117 1300", "302 1300"])


def test_the_radios_of_a_network_are_separated_by_channel_and_the_strongest_counts():
    data = Rssi.from_frame(packets(ssid=["Office"] * 4, channel=[1, 1, 36, 36]).rename(columns={"rsrp": "rssi"}))
    assert data.receiver_names == ("Office 1", "Office 36")
    np.testing.assert_allclose(data.rssi_dbm[:, 0], POWER[:, :2].max(axis=1))
    np.testing.assert_allclose(data.rssi_dbm[:, 1], POWER[:, 2:].max(axis=1))
    assert any("the strongest counts" in note for note in data.notes)


def test_a_network_of_radios_without_channels_has_the_power_of_the_strongest():
    apart = 2 * POWER + 60
    data = Rssi.from_frame(packets(ssid=["Office"] * 4).drop(columns="time").assign(rsrp=apart.T.ravel()))
    np.testing.assert_allclose(data.rssi_dbm[:, 0], apart.max(axis=1))
    pooled = Rssi.from_frame(packets(bssid=RADIOS, ssid=["Office"] * 4), pool_by="ssid")
    np.testing.assert_allclose(pooled.rssi_dbm[:, 0], POWER.max(axis=1))


def test_repeated_scans_of_one_network_stay():
    table = PLACE[["x", "y"]].assign(ssid="hall", rssi=POWER[:, 0])
    noise = np.random.default_rng(0).normal(0, 3, 3 * N).round()
    table = pd.concat([table] * 3, ignore_index=True)
    assert len(Rssi.from_frame(table.assign(rssi=table.rssi + noise))) == 3 * N


def test_virtual_access_points_of_one_radio_are_proposed_to_be_pooled():
    draw = np.random.default_rng(0)
    columns = {
        f"{radio[:-1]}{number}": POWER[:, c] + draw.integers(-1, 2, N)
        for c, radio in enumerate(RADIOS)
        for number in (0, 1)
    }
    data = Rssi.from_frame(PLACE.assign(**columns))
    (note,) = (note for note in data.notes if "--pool-by mac" in note)
    assert note.startswith("8 receivers share 4 radios")
    assert len(Rssi.from_frame(PLACE.assign(**columns), pool_by="mac").receiver_names) == 4
    apart = {f"{RADIOS[0][:-1]}{c}": POWER[:, c] for c in range(4)}  # of several places
    assert not any("--pool-by" in note for note in Rssi.from_frame(PLACE.assign(**apart)).notes)


@pytest.mark.parametrize("column", ["room", "Area", "zone_name", "location"])
@pytest.mark.parametrize("timed", [True, False])
def test_rooms_that_differ_at_one_place_may_be_the_receivers(column, timed):
    table = packets(**{column: ["kitchen", "hall", "office", "bath"]}).rename(columns={"rsrp": "rssi"})
    table = table if timed else table.drop(columns="time")
    with pytest.raises(InputError, match=f"is '{column}' the receiver of each row"):
        Rssi.from_frame(table)
    same_values(Rssi.from_frame(table, columns={"receiver": column}), names=["kitchen", "hall", "office", "bath"])


def test_the_room_of_a_walk_is_no_receiver():
    table = PLACE.assign(room=np.where(PLACE.x > PLACE.x.median(), "hall", "lab"), rssi=POWER[:, 0])
    assert Rssi.from_frame(table).receiver_names == ("rssi",)


@pytest.mark.parametrize("column", ["tx_power", "TxPower [dBm]", "eirp"])
@pytest.mark.parametrize("is_long", [True, False])
def test_differences_of_the_transmit_power_are_subtracted(column, is_long):
    transmitted = np.random.default_rng(0).choice([4, -4, -8], (N, 1), p=[0.6, 0.2, 0.2])
    truth = np.broadcast_to(POWER, (N, 4))
    sent = POWER + transmitted - 4
    if is_long:
        table = packets(**{column: transmitted}, mac=RADIOS).assign(rsrp=sent.T.ravel())
    else:
        table = PLACE.assign(**dict(zip(RADIOS, sent.T, strict=True)), **{column: transmitted[:, 0]})
    data = Rssi.from_frame(table)
    same_values(data, power=truth)
    assert any(f"{column} = 4" in note for note in data.notes)
    assert Rssi.from_frame(table, offset_by=column).groups.nunique() == 3  # as asked for


def test_a_column_of_transmit_power_that_rssi_does_not_follow_is_a_label():
    declared = np.random.default_rng(0).choice([4, -12], (N, 1))
    data = Rssi.from_frame(PLACE.assign(**dict(zip(RADIOS, POWER.T, strict=True)), tx_power=declared[:, 0]))
    same_values(data)
    assert data.labels == ("tx_power",)


@pytest.mark.parametrize("name", ["snr", "lsnr", "LoRa SNR [dB]"])
def test_the_power_of_packets_below_the_noise_follows_from_the_signal_to_noise_ratio(name):
    noise_dbm, truth = -117.0, POWER - 60.0
    total = 10 * np.log10(10 ** (truth / 10) + 10 ** (noise_dbm / 10))
    table = packets(gateway=["g1", "g2", "g3", "g4"], **{name: truth - noise_dbm}).assign(rssi=total.T.ravel())
    same_values(Rssi.from_frame(table.drop(columns="rsrp")), names=["g1", "g2", "g3", "g4"], power=truth)
    known = table.assign(rssi=truth.T.ravel()).drop(columns="rsrp")  # corrected already
    same_values(Rssi.from_frame(known), names=["g1", "g2", "g3", "g4"], power=truth)


def test_the_reference_power_of_lte_is_that_of_the_signal():
    table = packets(pci=[1, 2, 3, 4], snr=-5.0 - np.arange(N)[:, None] % 3)
    same_values(Rssi.from_frame(table), names=["1", "2", "3", "4"])


def test_the_rows_of_a_list_are_those_of_its_table():
    table = ranked("ap{}_bssid", "ap{}_rssi", 3)
    table.loc[4, "ap2_rssi"] = -400.0
    table.loc[5, "ap2_rssi"] = -401.0
    with pytest.raises(InputError, match="row 5, receiver"):
        Rssi.from_frame(table)
