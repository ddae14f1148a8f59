"""Radios of one access point as one receiver."""

import numpy as np
import pandas as pd
import pytest
import torch

from swiftwrf import InputError, Rssi, load_rssi

N = 200


def scans(n_radios=6, seed=0, noise_db=5.0):
    """Rows of two access points with several radios each."""
    draw = np.random.default_rng(seed)
    xy = draw.uniform(0, 20, (N, 2))
    truth = np.stack([-40 - 20 * np.log10(1 + np.hypot(*(xy - at).T)) for at in ((0, 0), (20, 20))], axis=1)
    table = pd.DataFrame({"x": xy[:, 0], "y": xy[:, 1]})
    for ap in range(2):
        for radio in range(n_radios):
            table[f"a4:56:cc:00:1{ap}:b{radio}"] = truth[:, ap] + noise_db * draw.normal(size=N)
    return table


def test_addresses_that_share_five_bytes_are_one_receiver():
    table = scans()
    data = Rssi.from_frame(table, pool_by="mac")
    assert data.receiver_names == ("a4:56:cc:00:10", "a4:56:cc:00:11")
    power = (10 ** (table.iloc[:, 2:8].to_numpy() / 10)).mean(axis=1)
    np.testing.assert_allclose(data.rssi_dbm[:, 0], 10 * np.log10(power))
    assert "12 radios are pooled into 2 receivers by mac: mean of their powers" in data.notes


def test_radios_that_detect_nothing_are_no_part_of_the_mean():
    table = pd.DataFrame(
        {"x": range(12), "y": 0.0, "hall-2G": -50.0, "hall-5G": [-50.0, np.nan, -100.0] * 4, "lab": -70.0}
    )
    data = Rssi.from_frame(table, pool_by="(.*)-.G")
    assert data.receiver_names == ("hall", "lab")
    assert data.rssi_dbm[:, 0].unique().tolist() == pytest.approx([-50.0])


def test_column_of_a_long_table(tmp_path):
    table = scans()
    long = table.assign(time=range(N)).melt(["x", "y", "time"], var_name="bssid", value_name="rssi")
    long["ssid"] = ["hall" if ":10:" in name else "lab" for name in long.bssid]
    long.to_csv(tmp_path / "walk.csv", index=False)
    (tmp_path / "receivers.csv").write_text("receiver,x,y,z\nhall,0,0,0\nlab,20,20,0\n")
    data, wide = load_rssi(tmp_path / "walk.csv", pool_by="ssid"), Rssi.from_frame(table, pool_by="mac")
    assert data.receiver_names == ("hall", "lab")
    assert data.receiver_position[1].tolist() == [20, 20, 0]
    torch.testing.assert_close(data.rssi_dbm, wide.rssi_dbm)
    long.loc[0, "ssid"] = "lab"
    with pytest.raises(InputError, match="has several values in column 'ssid'"):
        Rssi.from_frame(long, pool_by="ssid")
