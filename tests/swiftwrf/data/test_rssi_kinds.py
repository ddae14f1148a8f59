"""Kinds of RSSI tables that people have: fillers, rows without a fix, degrees, partial positions, other layouts.

Each is made from a floor with random positions, so that the expected measurements are known.
"""

import json
import re
from dataclasses import dataclass

import numpy as np
import pandas as pd
import pytest
import quick
import torch
from numpy.typing import NDArray

from swiftwrf import InputError, Rssi, RssiModel, load, load_rssi
from swiftwrf.choices import RSSI_PREDICTORS
from swiftwrf.data.coordinates import GeodeticOrigin
from swiftwrf.data.rssi import Offsets
from swiftwrf.data.splits import folds, places, random_split, repeated_fraction, slabs
from swiftwrf.data.writing import write_rssi
from swiftwrf.locate import RssiLocator
from swiftwrf.rssi import estimate_offsets

FEW_CELLS = ("--cells", "200")
NAMES = ["ap-a", "ap-b", "ap-c", "ap-d"]


@dataclass
class Floor:
    """A walk over a floor: positions (n, 3) [m], RSSI (n, 4) [dBm] in whole decibels, receivers (4, 3) [m]."""

    position: NDArray[np.float64]
    rssi: NDArray[np.float64]
    receiver: NDArray[np.float64]
    random: np.random.Generator

    @classmethod
    def made(cls, seed: int, n: int = 120) -> "Floor":
        random = np.random.default_rng(seed)
        position = np.column_stack([random.uniform(0.7, 31, n), random.uniform(0.6, 17, n), np.full(n, 1.1)]).round(2)
        receiver = np.column_stack([random.uniform(0, 31, 4), random.uniform(0, 17, 4), np.full(4, 2.8)]).round(1)
        distance = np.linalg.norm(position[:, None] - receiver, axis=2)
        rssi = (-41 - 26 * np.log10(distance) + random.normal(0, 2, (n, 4))).round()
        return cls(position, rssi, receiver, random)

    def some(self, share: float) -> NDArray[np.bool_]:
        return self.random.random(self.rssi.shape) < share

    def table(self, rssi: NDArray[np.float64] | None = None) -> pd.DataFrame:
        values = pd.DataFrame(self.rssi if rssi is None else rssi, columns=NAMES)
        return pd.concat([pd.DataFrame(self.position, columns=["x", "y", "z"]), values], axis=1)

    def write_receivers(self, folder, names=NAMES) -> None:
        table = pd.DataFrame(self.receiver[: len(names)], columns=["x", "y", "z"])
        table.insert(0, "receiver", names)
        table.to_csv(folder / "receivers.csv", index=False)

    def degrees(self, latitude: float, longitude: float) -> NDArray[np.float64]:
        """Latitudes and longitudes (n, 2) of the positions [deg], their first coordinate to the east."""
        return GeodeticOrigin(latitude, longitude).to_degrees(self.position[:, :2])


@pytest.fixture
def floor():
    return Floor.made(3)


def noted(data, *words):
    """Return True if a note contains all of these words."""
    return any(all(word in note for word in words) for note in data.notes)


def cells(data):
    return torch.where(data.rssi_dbm.isnan(), 0.0, data.rssi_dbm).numpy()


@pytest.mark.parametrize("share", [0.04, 0.6])
@pytest.mark.parametrize(
    "filler", ["127", "100", "0", "1", "255", "-105", "-98", "-110", "-127", "-200", "-100", "-inf", ""]
)
def test_fillers_are_no_power(tmp_path, floor, filler, share):
    """Also where a few real values lie just above a filler at the lower edge."""
    value = float(filler or "nan")
    if np.isfinite(value) and -150 < value < -90:
        floor.rssi[:3, 0], floor.rssi[3:5, 1] = value + 1, value + 2
    filled = floor.some(share)
    expected = np.where(filled, 0, floor.rssi)
    floor.table(np.where(filled, value, floor.rssi)).to_csv(tmp_path / "walk.csv", index=False)
    data = load_rssi(tmp_path / "walk.csv")
    assert data.receiver_names == tuple(NAMES)
    np.testing.assert_array_equal(cells(data), expected)
    assert not filler or noted(data, f"{filler} counts as not detected", f"{filled.sum()} of {filled.size}")
    long = floor.table(np.where(filled, value, floor.rssi)).assign(time=range(len(filled)))
    long = long.melt(["time", "x", "y", "z"], var_name="receiver", value_name="rssi")
    long.to_csv(tmp_path / "long.csv", index=False)
    assert np.isnan(load_rssi(tmp_path / "long.csv").rssi_dbm.numpy()).sum() == filled.sum()


def test_the_user_decides_on_fillers(tmp_path, floor):
    filled = floor.some(0.3)
    floor.table(np.where(filled, -104, floor.rssi)).to_csv(tmp_path / "walk.csv", index=False)
    assert not load_rssi(tmp_path / "walk.csv", filler=[]).rssi_dbm.isnan().any()
    weakest = floor.rssi.min()
    data = load_rssi(tmp_path / "walk.csv", filler=[weakest])
    np.testing.assert_array_equal(data.rssi_dbm.isnan().numpy(), (floor.rssi == weakest) & ~filled)


def test_sound_values_are_no_fillers(tmp_path, floor):
    """Weakest and strongest values of usual tables, one of them at -100 dBm and below."""
    for shift in (0, -25, 40):
        floor.table(floor.rssi + shift).to_csv(tmp_path / "walk.csv", index=False)
        data = load_rssi(tmp_path / "walk.csv")
        assert not data.rssi_dbm.isnan().any()
        assert not noted(data, "not detected")


@pytest.mark.parametrize("fix", [np.nan, 0, -1, 999, -9999])
def test_rows_without_a_fix_are_left_out(tmp_path, floor, fix):
    lost = np.zeros(len(floor.position), dtype=bool)
    lost[floor.random.choice(len(lost), 9, replace=False)] = True
    table = floor.table()
    table.loc[lost, ["x", "y", "z"]] = fix
    table.to_csv(tmp_path / "walk.csv", index=False)
    (tmp_path / "train_index_days.txt").write_text("\n".join(map(str, range(60))))
    (tmp_path / "test_index_days.txt").write_text("\n".join(map(str, range(60, 120))))
    data = load_rssi(tmp_path / "walk.csv")
    np.testing.assert_allclose(data.transmitter_position, floor.position[~lost])
    np.testing.assert_array_equal(data.rssi_dbm, floor.rssi[~lost])
    np.testing.assert_array_equal(data.index, np.flatnonzero(~lost))
    assert noted(data, "left out", "9 of 120")
    train, test = data.split("days")
    assert (len(train), len(test)) == ((~lost)[:60].sum(), (~lost)[60:].sum())
    assert int(train.index.max()) < 60 <= int(test.index.min())


def test_the_corner_of_a_grid_is_a_position(tmp_path):
    grid = [[0.5 * i, 0.5 * j, 1.0, -60 - i - j] for i in range(6) for j in range(6) for _ in range(3)]
    pd.DataFrame(grid, columns=["x", "y", "z", "ap"]).to_csv(tmp_path / "walk.csv", index=False)
    assert len(load_rssi(tmp_path / "walk.csv")) == 108


DEGREES = {
    "by name": (["longitude", "latitude"], (52.51, 13.4)),
    "the other way round": (["Lat", "Lng"], (-33.85, 151.2)),
    "of a phone": (["GPS Longitude", "GPS Latitude"], (40.7, -74.0)),
    "called x and y": (["X", "Y"], (35.68, 139.7)),
    "called x and y, swapped": (["x", "y"], (-33.4, -100.6)),
    "called pos_x and pos_y": (["pos_x", "pos_y"], (-1.29, 36.8)),
    "across the antimeridian": (["lon", "lat"], (-17.7, 180.0)),
}


@pytest.mark.parametrize("kind", DEGREES)
def test_degrees_become_local_metres(tmp_path, floor, kind):
    header, at = DEGREES[kind]
    degrees = floor.degrees(*at)
    degrees[:, 1] = (degrees[:, 1] + 180) % 360 - 180
    columns = degrees if header[0] == "Lat" or "swapped" in kind else degrees[:, ::-1]
    table = pd.concat([pd.DataFrame(columns, columns=header), floor.table().drop(columns=["x", "y"])], axis=1)
    table.to_csv(tmp_path / "walk.csv", index=False)
    data = load_rssi(tmp_path / "walk.csv")
    assert data.receiver_names == tuple(NAMES)
    between = [torch.cdist(p, p) for p in (data.transmitter_position, torch.from_numpy(floor.position))]
    torch.testing.assert_close(*between, atol=1e-3, rtol=1e-5)
    east = np.corrcoef(data.transmitter_position[:, 0], floor.position[:, 0])[0, 1]
    assert east > 0.999999
    np.testing.assert_allclose(data.origin.to_degrees(data.transmitter_position[:, :2].numpy())[:, 0], degrees[:, 0])
    assert noted(data, "projected to local metres", f"{data.origin.latitude:.7g}")


def test_receivers_of_a_table_in_degrees(tmp_path, floor):
    degrees = floor.degrees(48.2, 16.37)
    table = floor.table().assign(x=degrees[:, 1], y=degrees[:, 0]).rename(columns={"x": "lon", "y": "lat"})
    table.to_csv(tmp_path / "walk.csv", index=False)
    place = GeodeticOrigin(48.2, 16.37).to_degrees(floor.receiver[:, :2])
    own = pd.DataFrame({"receiver": NAMES, "latitude": place[:, 0], "longitude": place[:, 1], "altitude": 2.8})
    own.to_csv(tmp_path / "receivers.csv", index=False)
    data = load_rssi(tmp_path / "walk.csv")
    expected = np.linalg.norm(floor.position[:, None] - floor.receiver, axis=2)
    np.testing.assert_allclose(torch.cdist(data.transmitter_position, data.receiver_position), expected, atol=1e-3)
    floor.write_receivers(tmp_path)
    with pytest.raises(InputError, match=r"receivers\.csv: positions must be in degrees"):
        load_rssi(tmp_path / "walk.csv")


def test_degrees_or_metres_is_asked_once(tmp_path, floor):
    table = floor.table().rename(columns={"x": "longitude", "y": "latitude"})
    table.to_csv(tmp_path / "walk.csv", index=False)
    with pytest.raises(InputError, match=r"--coordinates degrees or --coordinates metres"):
        load_rssi(tmp_path / "walk.csv")
    data = load_rssi(tmp_path / "walk.csv", coordinates="metres")
    np.testing.assert_allclose(data.transmitter_position, floor.position)
    drive = floor.table().assign(x=23.7 + floor.position[:, 0] / 100, y=61.5 + floor.position[:, 1] / 100)
    drive.to_csv(tmp_path / "drive.csv", index=False)
    with pytest.raises(InputError, match="may be degrees or metres"):
        load_rssi(tmp_path / "drive.csv")
    extent = np.ptp(load_rssi(tmp_path / "drive.csv", coordinates="degrees").transmitter_position.numpy(), axis=0)
    assert 10_000 < extent[0] < 30_000
    assert not load_rssi(tmp_path / "drive.csv", coordinates="metres").origin


def test_a_wardriving_log(tmp_path, floor):
    """A line of metadata, one packet a row, degrees, rows without a fix and names with commas."""
    degrees = floor.degrees(-22.9, -43.2)
    lost = floor.random.choice(len(degrees), 5, replace=False)
    degrees[lost] = 0
    lines = ["WigleWifi-1.4,appRelease=2.80,model=Phone,release=13,device=phone,display=x,board=y,brand=z"]
    lines += [
        "MAC,SSID,AuthMode,FirstSeen,Channel,RSSI,CurrentLatitude,CurrentLongitude,AltitudeMeters,AccuracyMeters,Type"
    ]
    for i, (latitude, longitude) in enumerate(degrees):
        for name, rssi in zip(NAMES, floor.rssi[i], strict=True):
            place = f"{latitude:.8f},{longitude:.8f},{0 if i in lost else 12.5},4"
            lines.append(f'{name},"cafe, wifi",[WPA2],2026-04-02 08:{i // 60:02}:{i % 60:02},6,{rssi:.0f},{place},WIFI')
    (tmp_path / "log.csv").write_text("\r\n".join(lines))
    data = load_rssi(tmp_path / "log.csv")
    kept = np.setdiff1d(np.arange(len(degrees)), lost)
    np.testing.assert_array_equal(data.rssi_dbm, floor.rssi[kept])
    np.testing.assert_allclose(np.ptp(data.transmitter_position[:, 0]), np.ptp(floor.position[kept, 0]), atol=0.01)
    assert float(data.transmitter_position[0, 2]) == 12.5
    assert noted(data, "lines before the header are skipped: 1")


def test_positions_of_some_receivers(tmp_path, floor):
    floor.table().to_csv(tmp_path / "walk.csv", index=False)
    floor.write_receivers(tmp_path, NAMES[:3])
    data = load_rssi(tmp_path / "walk.csv")
    with (tmp_path / "receivers.csv").open("a") as stream:
        stream.write("ap-d,,,\n")
    assert torch.equal(load_rssi(tmp_path / "walk.csv").receiver_located, data.receiver_located)
    assert data.receiver_located.tolist() == [True, True, True, False]
    assert noted(data, "ap-d", "no path-loss model")
    write_rssi(data, tmp_path)
    for line in ("", "ap-d: null\n", "ap-d:\n"):
        with (tmp_path / "gateway_position.yml").open("a") as stream:
            stream.write(line)
        assert load_rssi(tmp_path).receiver_located.tolist() == [True, True, True, False]
        write_rssi(data, tmp_path)


@pytest.mark.parametrize("layout", ["raw", "receiver moves"])
def test_other_nerf2_layouts(tmp_path, floor, layout):
    positions, table = ("beacon_pos.csv", "rssi.csv") if layout == "raw" else ("rx_pos.csv", "gateway_rssi.csv")
    pd.DataFrame(floor.rssi, columns=NAMES).to_csv(tmp_path / table, index=False)
    rows = "\n".join(",".join(map(str, row)) for row in floor.position)
    (tmp_path / positions).write_text(f"x, y, z\n{rows}\n")
    if layout == "raw":
        pd.DataFrame(floor.receiver, columns=["x", "y", "z"]).to_csv(tmp_path / "gateway_pos.csv", index=False)
    else:
        lines = [f"{name}: {place.tolist()}" for name, place in zip(NAMES, floor.receiver, strict=True)]
        (tmp_path / "gateway_position.yml").write_text("\n".join(lines))
    data = load_rssi(tmp_path)
    np.testing.assert_array_equal(data.rssi_dbm, floor.rssi)
    np.testing.assert_allclose(data.transmitter_position, floor.position)
    np.testing.assert_allclose(data.receiver_position, floor.receiver)
    assert noted(data, "the receiver moves") == (layout == "receiver moves")


@pytest.mark.parametrize("names", [["gateway", "device"], ["ap", "b"], ["rx", "b"], ["sensor", "mac"]])
def test_a_receiver_called_gateway(tmp_path, floor, names):
    table = floor.table()[["x", "y", "z", *NAMES[:2]]].set_axis(["x", "y", "z", *names], axis=1)
    table.to_csv(tmp_path / "walk.csv", index=False)
    for columns in (None, {"rssi": "*"}):
        data = load_rssi(tmp_path / "walk.csv", columns=columns)
        assert data.receiver_names == tuple(names)
        np.testing.assert_array_equal(data.rssi_dbm, floor.rssi[:, :2])


def test_sod_indoor_loc(tmp_path, floor):
    filled = floor.some(0.7)
    table = pd.DataFrame(np.where(filled, -105, floor.rssi), columns=[f"MAC{i}" for i in range(1, 5)])
    table["ECoord"], table["NCoord"], table["FloorID"] = floor.position[:, 0], floor.position[:, 1], 3
    table["BuildingID"], table["UserID"], table["PhoneID"], table["SampleTimes"] = 1, 2, 3, 10
    table.to_csv(tmp_path / "Training.csv", index=False)
    data = load_rssi(tmp_path / "Training.csv")
    assert data.receiver_names == ("MAC1", "MAC2", "MAC3", "MAC4")
    np.testing.assert_array_equal(data.rssi_dbm.isnan(), filled)
    assert data.transmitter_position[0].tolist() == [*floor.position[0, :2], 12.0]


def test_a_place_measured_again_is_in_one_part_of_every_random_split(floor):
    place = torch.from_numpy(floor.position[:40])
    position = place.repeat_interleave(torch.arange(40) % 5 + 1, dim=0)
    position = position[torch.from_numpy(floor.random.permutation(len(position)))]
    data = Rssi(torch.full((len(position), 1), -60.0), position)
    train, test = data.split("random")
    assert repeated_fraction(train.transmitter_position, test.transmitter_position) == 0
    assert abs(len(test) / len(data) - 0.2) < 0.05
    fold = folds(position, "random", seed=1)
    assert fold.unique().tolist() == [0, 1, 2, 3, 4]
    for spot in place:
        assert len(fold[(position == spot).all(dim=1)].unique()) == 1
    frequent = torch.cat([position, place[:1].expand(3 * len(position), 3)])
    train, test = random_split(frequent, seed=0)
    assert len(test) >= 0.1 * len(position)
    assert len(train) + len(test) == len(frequent)


@pytest.mark.parametrize(
    ("n_places", "extent", "error"),
    [
        (30, (12, 12, 12), 0.01),
        (10, (2, 1, 0), 0.005),  # motion capture of a robot that returns to ten places
        (8, (9, 0, 0), 0.004),  # a corridor
        (40, (300, 200, 0), 0.7),  # a satellite receiver
    ],
)
def test_positions_measured_again_differ_by_the_error_of_positioning(n_places, extent, error):
    draw = np.random.default_rng(0)
    grid = np.linspace(0.05, 0.95, n_places)
    place = np.stack([grid, grid * 7 % 1, grid * 3 % 1], axis=1) * extent
    position = torch.from_numpy(place.repeat(8, axis=0) + draw.uniform(-error, error, (8 * n_places, 3)))
    number = torch.arange(n_places).repeat_interleave(8)
    found = places(position)
    assert len(found.unique()) == n_places == len(torch.stack([found, number]).unique(dim=1).T)
    for held_out in (folds(position, "random", 0), folds(position, "block", 0)):
        assert len(torch.stack([held_out, number]).unique(dim=1).T) == n_places
        assert len(held_out.unique()) == 5
    train, test = random_split(position, seed=0)
    assert repeated_fraction(position[train], position[test]) == 0
    assert repeated_fraction(position[::2], position[1::2]) == 1
    spread = torch.from_numpy(draw.uniform(0, 12, (240, 3)))
    assert repeated_fraction(spread[:200], spread[200:]) < 0.05


def test_a_dense_path_is_not_one_place():
    along = torch.linspace(0, 8, 4000, dtype=torch.float64)
    path = torch.stack([along, along.sin(), torch.zeros_like(along)], dim=1)
    assert len(places(path).unique()) > 100
    one = places(torch.ones(7, 3)), places(torch.ones(7, 3), 2)
    assert [found.tolist() for found in one] == [[0] * 7, [*range(7)]]


@pytest.mark.parametrize("validation", ["random", "block"])
@pytest.mark.parametrize("kind", ["random", "grid", "repeated"])
def test_the_order_of_rows_changes_no_fold(validation, kind, generator):
    position = 9 * torch.rand(83, 3, generator=generator, dtype=torch.float64)
    if kind == "grid":
        position = torch.cartesian_prod(torch.arange(12.0), torch.arange(7.0), torch.ones(1)).double()
    elif kind == "repeated":
        position = torch.cat([position, position[:40] + 1e-3, position[:9]])
    order = torch.randperm(len(position), generator=generator)
    for held_out in (lambda at: folds(at, validation, 3), lambda at: slabs(at, 5), places):
        assert held_out(position[order]).tolist() == held_out(position)[order].tolist()


@pytest.mark.parametrize(("task", "options"), [("rssi", ()), ("locate", FEW_CELLS)])
def test_notes_and_a_split_that_tests_look_up_are_in_every_report(tmp_path, task, options, capsys):
    floor = Floor.made(5, n=30)
    order, filled = floor.random.permutation(60), floor.some(0.2)
    table = pd.concat([floor.table(np.where(filled, -107, floor.rssi))] * 2, ignore_index=True)
    (tmp_path / "walk").mkdir()
    table.to_csv(tmp_path / "walk" / "walk.csv", index=False)
    (tmp_path / "walk" / "train_index.txt").write_text("\n".join(map(str, order[:48])))
    (tmp_path / "walk" / "test_index.txt").write_text("\n".join(map(str, order[48:])))
    source = ("--rx", "all", "--data", tmp_path / "walk", *options)
    assert quick.run(task, *source, "--out", tmp_path / "run") == 0
    page = (tmp_path / "run" / "report.html").read_text()
    first = page[: page.index("What to do next")]
    assert re.search(r"This split tests look-up: [5-9]\d% of the test rows", first)
    assert f"-107 counts as not detected: {2 * filled.sum()} of 240 cells" in first
    if task == "rssi":
        (tmp_path / "walk" / "reading.yaml").write_text("filler: none")
        assert quick.run(task, *source, "--out", tmp_path / "kept") == 0
        assert "counts as not detected" not in (tmp_path / "kept" / "report.html").read_text()
        assert quick.run("inspect", tmp_path / "walk", "--out", tmp_path / "inspect") == 0
        assert "Split random tests look-up" in capsys.readouterr().out


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_the_lengths_of_a_gaussian_process_follow_the_extent(floor, scale):
    data = Rssi(floor.rssi, scale * floor.position, receiver_position=scale * floor.receiver, receiver_names=NAMES)
    train, test = data.split("random")
    errors = [
        float((RSSI_PREDICTORS[name]().fit(train).predict(test.transmitter_position).mean - test.rssi_dbm).abs().mean())
        for name in ("gp", "mean")
    ]
    assert errors[0] < 0.6 * errors[1]


def test_outputs_of_a_table_in_degrees(tmp_path):
    """Positions come back in degrees, also those of a later log with another median."""
    floor = Floor.made(5, n=60)
    degrees = floor.degrees(59.33, 18.07)
    table = floor.table().assign(x=degrees[:, 1], y=degrees[:, 0]).rename(columns={"x": "lon", "y": "lat"})
    table[:40].to_csv(tmp_path / "walk.csv", index=False)
    table[40:].to_csv(tmp_path / "later.csv", index=False)
    run = tmp_path / "rssi"
    assert quick.run("rssi", "--rx", "all", "--data", tmp_path / "walk.csv", "--out", run) == 0
    assert "unknown positions of access points" in (run / "report.html").read_text()
    predicted = pd.read_csv(run / "predictions.csv")
    near = np.abs(predicted[["latitude_deg", "longitude_deg"]].to_numpy()[:, None] - degrees).max(axis=2).min(axis=1)
    assert near.max() < 1e-8
    cells = pd.read_csv(run / "figures" / "summary.csv")
    assert cells["latitude_deg"].between(*(degrees[:, 0].min() - 1e-4, degrees[:, 0].max() + 1e-4)).all()
    data = load_rssi(tmp_path / "walk.csv")
    locator = RssiLocator(n_cells=300).fit(data)
    locator.save(tmp_path / "locator.safetensors")
    assert load(tmp_path / "locator.safetensors").model.origin == data.origin
    found = tmp_path / "positions.csv"
    assert quick.command("predict", tmp_path / "locator.safetensors", tmp_path / "later.csv", "--out", found) == 0
    positions = pd.read_csv(found)
    truth = data.origin.to_metres(degrees[40:])
    np.testing.assert_allclose(positions[["truth_x_m", "truth_y_m"]], truth, atol=1e-3)
    estimate = data.origin.to_metres(positions[["latitude_deg", "longitude_deg"]].to_numpy())
    # both are rounded to a millimetre
    np.testing.assert_allclose(estimate, positions[["x_m", "y_m"]], atol=2e-3)


def grouped_tables(floor, kind, tmp_path):
    """Write a table of two devices (wide) or three channels (long); return it, the column and the offsets [dB]."""
    receiver = pd.DataFrame(floor.receiver, columns=["x", "y", "z"])
    receiver.insert(0, "receiver", NAMES)
    receiver.to_csv(tmp_path / "receivers.csv", index=False)
    if kind == "devices":
        offset = {"pixel": 0.0, "galaxy": -11.0}
        device = floor.random.choice(list(offset), len(floor.rssi), p=[0.6, 0.4])
        table = floor.table(floor.rssi + np.array([offset[name] for name in device])[:, None]).assign(Device=device)
    else:
        offset = {"37": 0.0, "38": 6.0, "39": -5.0}
        frame = floor.table().melt(["x", "y", "z"], var_name="gateway", value_name="rssi")
        frame = frame.loc[frame.index.repeat(3)].reset_index(drop=True)
        frame["ch"] = list(offset) * (len(frame) // 3)
        frame["rssi"] += frame["ch"].map(offset) + floor.random.normal(0, 1, len(frame))
        table = frame[floor.random.random(len(frame)) < 0.8]  # packets are lost
    table.to_csv(tmp_path / "walk.csv", index=False)
    return "Device" if kind == "devices" else "ch", offset


@pytest.mark.parametrize("kind", ["devices", "channels"])
def test_offsets_between_groups_of_rows(tmp_path, floor, kind, capsys):
    column, truth = grouped_tables(floor, kind, tmp_path)
    data = load_rssi(tmp_path / "walk.csv", offset_by=column)
    train, test = data.split("random")
    reference = next(iter(truth))
    offsets = estimate_offsets(train, reference)
    assert offsets.offset_db == pytest.approx(truth, abs=0.8)
    errors = []
    for known in (Offsets(column, reference, {}, 0.0), offsets):
        predicted = RssiModel().fit(known.removed(train)).predict(test.transmitter_position).mean
        errors.append(float((predicted + known.of(test)[:, None] - test.rssi_dbm).abs().nanmedian()))
    assert errors[1] < 0.65 * errors[0]
    assert quick.run("inspect", tmp_path / "walk.csv", "--out", tmp_path / "inspect") == 0
    assert f"--offset-by {column}" in capsys.readouterr().out


def test_columns_without_offsets_are_not_proposed(tmp_path, floor, capsys):
    zone = np.where(floor.position[:, 0] < 15, "west", "east")
    table = floor.table().assign(zone=zone, day=floor.random.choice(["monday", "friday"], len(zone)))
    table.to_csv(tmp_path / "walk.csv", index=False)
    assert quick.run("inspect", tmp_path / "walk.csv", "--out", tmp_path / "inspect") == 0
    assert "--offset-by" not in capsys.readouterr().out


def test_a_run_with_offsets(tmp_path, capsys):
    """Measured values stay those of the table, predictions are of each row's group, and the locator knows the offsets."""
    floor = Floor.made(7, n=60)
    column, truth = grouped_tables(floor, "devices", tmp_path)
    reading = tmp_path / "walk.csv.reading.yaml"
    reading.write_text(f"offset_by: {column}=galaxy")
    source = ("--rx", "all", "--data", tmp_path / "walk.csv")
    assert quick.run("rssi", *source, "--out", tmp_path / "rssi") == 0
    notes = json.loads((tmp_path / "rssi" / "metrics.json").read_text())["notes"]
    assert any(f"offsets of {column} relative to galaxy" in note for note in notes)
    predicted = pd.read_csv(tmp_path / "rssi" / "predictions.csv")
    assert set(predicted["group"]) == set(truth)
    table = pd.read_csv(tmp_path / "walk.csv")
    assert predicted["measured"].isin(table[NAMES].to_numpy().ravel()).all()
    assert load(tmp_path / "rssi" / "model.safetensors").offsets.reference == "galaxy"
    reading.write_text("offset_by: nowhere")
    assert quick.run("rssi", *source, "--out", tmp_path / "other") == 2
    assert "no column 'nowhere' for offsets" in capsys.readouterr().err
    data = load_rssi(tmp_path / "walk.csv", offset_by=column)
    known = estimate_offsets(data, "pixel")
    RssiLocator(n_cells=200).fit(known.removed(data)).save(tmp_path / "locator.safetensors")
    found = []
    for other in ("galaxy", "pixel"):  # the same transmitters, each measured by another device
        rssi = floor.rssi + truth[other]
        measured = floor.table(rssi)[NAMES].assign(Device=other)
        measured.to_csv(tmp_path / f"{other}.csv", index=False)
        out = tmp_path / f"{other}-positions.csv"
        assert quick.command("predict", tmp_path / "locator.safetensors", tmp_path / f"{other}.csv", "--out", out) == 0
        found.append(pd.read_csv(out)[["x_m", "y_m"]].to_numpy())
    assert np.median(np.linalg.norm(found[0] - found[1], axis=1)) < 1.0


@pytest.mark.data
@pytest.mark.parametrize("name", ["kolak", "lora-campus", "tetam-tracks", "tetam-fingerprints", "dcm-rssi"])
def test_measured_tables_are_read_without_options(measured_data, name):
    data = load_rssi(measured_data / name)
    fillers = [note for note in data.notes if "not detected" in note]
    assert all(note.startswith("-100 ") for note in fillers)
    assert data.located
