"""Coverage by band of a walk whose table has a column of frequencies, against counted scans and plain NumPy."""

import json

import numpy as np
import pandas as pd
import pytest
import quick
from scipy.stats import norm

from swiftwrf import load, load_rssi
from tasks.view.rssi import MapSelection
from tasks.view.sources import open_source

DRAW = np.random.default_rng(0)
PLACE = DRAW.uniform(0, (30, 12), (90, 2))
RADIOS = {"r1": 2412, "r2": 5180, "r3": 2437, "r4": 5500}  # frequencies [MHz]
GHZ = np.array(["2.4 GHz" if mhz < 3000 else "5 GHz" for mhz in RADIOS.values()])
DISTANCE = np.linalg.norm(PLACE[:, None] - np.array([[5, 6], [5, 6], [25, 6], [25, 6]]), axis=2) + 1
RSSI = -38 - 12 * (GHZ == "5 GHz") - 25 * np.log10(DISTANCE) + DRAW.normal(0, 3, DISTANCE.shape)
RSSI[RSSI < -85] = np.nan


def write(folder):
    """A row for each packet."""
    tables = [
        pd.DataFrame(PLACE, columns=["x", "y"]).assign(scan=range(90), bssid=name, freq=mhz, rssi=RSSI[:, number])
        for number, (name, mhz) in enumerate(RADIOS.items())
    ]
    file = folder / "walk.csv"
    pd.concat(tables).dropna().sort_values("scan", kind="stable").drop(columns="scan").to_csv(file, index=False)
    return file


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bands")
    assert quick.run("rssi", "--data", write(folder), "--above", -67, -60, "--out", folder / "run") == 0
    return folder / "run"


def test_each_band_is_counted_beside_each_receiver(run):
    bands, data = (
        pd.read_csv(run / "bands.csv").set_index(["threshold_dbm", "band"]),
        load_rssi(run.parent / "walk.csv"),
    )
    train, test = data.split()
    model = load(run / "model.safetensors")
    found, detection = model.predict_detected(test), model.predict_detection(test.transmitter_position)
    factor = np.random.default_rng(1).normal(size=(20_000, 1, 1))  # which the errors of a scan share
    for threshold in (-67.0, -60.0):
        for band in ("2.4 GHz", "5 GHz"):
            row, of_band = bands.loc[(threshold, band)], [RADIOS[name] < 3000 for name in data.receiver_names]
            of_band = np.array(of_band) == (band == "2.4 GHz")
            for name, part in (("scans_above", train), ("test_above", test)):
                assert row[name] == pytest.approx((part.rssi_dbm.numpy()[:, of_band] > threshold).any(axis=1).mean())
            above = detection.numpy() * norm.cdf((found.mean.numpy() - threshold) / found.std.numpy())
            score = norm.ppf(above[:, of_band]) + np.sqrt(0.2) * factor
            missing = norm.cdf(-score / np.sqrt(0.8)).prod(axis=2).mean()
            assert row["test_predicted"] == pytest.approx(1 - missing, abs=0.01)
    every = pd.read_csv(run / "coverage.csv")
    assert "band" not in every
    assert (bands["covered"].to_numpy() <= every[every["receiver"] == "any receiver"]["covered"].max() + 1e-9).all()


def test_answer_report_and_page_have_the_bands(run, capsys, tmp_path):
    metrics, bands = json.loads((run / "metrics.json").read_text()), pd.read_csv(run / "bands.csv")
    first = bands[bands["threshold_dbm"] == -67].set_index("band")["covered"]
    assert {row["band"]: row["covered"] for row in metrics["bands"][:2]} == pytest.approx(first.to_dict())
    assert quick.run("rssi", "--data", run.parent / "walk.csv", "--above", -67, "--json", "--out", tmp_path / "o") == 0
    sentence = f"The measured area is covered to {first['2.4 GHz']:.0%} by 2.4 GHz, {first['5 GHz']:.0%} by 5 GHz."
    assert sentence in json.loads(capsys.readouterr().out)["conclusion"]
    page = (run / "report.html").read_text()
    assert "Coverage by band" in page
    assert sentence in page
    view, height = open_source(run), 0.0
    shown = view.coloured(MapSelection("coverage", 0, height, -67.0, at_least=1, band="5 GHz"))
    assert "is covered (one of 2 receivers of 5 GHz above -67 dBm with at least 90% probability)" in shown.sentence
    counted = (RSSI[:, GHZ == "5 GHz"] > -67).any(axis=1)[load_rssi(run.parent / "walk.csv").split()[0].index]
    assert f"{counted.mean():.0%} of the {len(counted)} scans pass" in shown.sentence


def test_bands_beside_a_wide_table_need_no_positions(tmp_path):
    pd.DataFrame(PLACE, columns=["x", "y"]).assign(**dict(zip(RADIOS, RSSI.T, strict=True))).to_csv(
        tmp_path / "wide.csv", index=False
    )
    (tmp_path / "receivers.csv").write_text("receiver,channel\nr3,6\nr1,1\nr2,36\nr4,100\n")
    data = load_rssi(tmp_path / "wide.csv")
    assert dict(zip(data.receiver_names, data.bands, strict=True)) == dict(zip(RADIOS, GHZ, strict=True))
    assert data.columns([3, 0]).receivers_by_band == {"2.4 GHz": [1], "5 GHz": [0]}
    assert not data.located


def test_a_channel_that_changes_from_packet_to_packet_is_no_band(tmp_path):
    table = pd.read_csv(write(tmp_path))
    table.assign(freq=DRAW.choice([37, 38, 39], len(table))).to_csv(tmp_path / "walk.csv", index=False)
    assert load_rssi(tmp_path / "walk.csv").bands is None
