"""From the raw files of public data sets to the toolkit's layouts, with the splits of docs/results.md."""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy.io import loadmat

from swiftwrf.data.paths import PropagationPaths
from swiftwrf.data.powers import NOT_DETECTED_DBM
from swiftwrf.data.rssi import Rssi
from swiftwrf.data.writing import write_paths, write_rssi, write_splits
from swiftwrf.errors import InputError

Split = tuple[torch.Tensor, torch.Tensor]
Mask = NDArray[np.bool_]

PICKLED = {  # names in the pickled tables of NeWRF; others are refused
    ("builtins", "slice"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.numeric", "_frombuffer"),
    ("pandas._libs.internals", "_unpickle_block"),
    ("pandas.core.frame", "DataFrame"),
    ("pandas.core.indexes.base", "Index"),
    ("pandas.core.indexes.base", "_new_Index"),
    ("pandas.core.internals.managers", "BlockManager"),
}
S23_TRAINING = 160  # spectra before the block of the path that tests
LORA_GATEWAY = (-21.7788416255599, -43.373362355391, 932.0)  # latitude, longitude [deg], altitude [m]
WIFI_GRID_M = 0.6
# x and y in cells of the grid, and the columns of their RSSI: AP1 is never received in the corridor
WIFI_ACCESS_POINTS: dict[str, tuple[list[float], list[float], list[int]]] = {
    "office": ([1, 11, 15, 20, 25], [5, -1, 6, -1, 5], [1, 2, 3, 4, 5]),
    "lecture_theatre": ([3, 10, 18.8, 3, 19], [9, 9, 9, 21, 21], [1, 2, 3, 4, 5]),
    "corridor": ([2, 17, 38, 48], [7.5, 6.8, 9, 5], [2, 3, 4, 5]),
}


def s23(raw: Path, out: Path) -> None:
    """Copy the spectra, which have the layout already, and add the split of the path's last part."""
    shutil.copytree(raw / "data_test200", out, dirs_exist_ok=True)
    count = len(list((out / "spectrum").glob("*.png")))
    write_splits({"block": _parts(np.arange(count) >= S23_TRAINING)}, out, first=1)


class _TableUnpickler(pickle.Unpickler):
    """Loads tables of pandas and arrays of NumPy only, so a file runs no code."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("pandas.core.indexes.numeric", "Int64Index"):  # of pandas 1
            return pd.Index
        module = module.replace("numpy.core", "numpy._core")  # of NumPy 1
        if (module, name) not in PICKLED:
            raise InputError(f"the pickled table contains {module}.{name}, which is not loaded")
        return super().find_class(module, name)


def newrf(raw: Path, out: Path) -> None:
    """Write the ray paths of a pickled table; receivers without a path are left out."""
    (file,) = raw.glob("data/*.pkl")
    with file.open("rb") as stream:
        table = _TableUnpickler(stream).load()
    table = table.dropna()
    count = np.array([len(gain.ravel()) for gain in table["RxChanPerRay"]])
    receiver = np.stack(table["RxPos"].to_numpy())
    last = np.concatenate([points.T for points in table["LastXPts"]])
    write_paths(
        PropagationPaths(
            transmitter=torch.from_numpy(np.stack(table["TxPos"].to_numpy())),
            receiver=torch.from_numpy(receiver),
            count=torch.from_numpy(count),
            direction=torch.from_numpy(last - receiver.repeat(count, axis=0)),
            gain=torch.from_numpy(
                np.concatenate([gain.ravel() for gain in table["RxChanPerRay"]]).astype(np.complex64)
            ),
            line_of_sight=torch.from_numpy(table["LineOfSight"].to_numpy().astype(bool)),
            frequency_hz=float(table["Frequency"].iloc[0]) * 1e9,
            corner=torch.from_numpy(last)[:, None],
        ),
        out,
    )


def tetam_tracks(raw: Path, out: Path) -> None:
    """Write one row for each advertisement: median RSSI of each receiver, mean position."""
    text = (raw / "cnf/tetam.dev").read_text().splitlines()[0].removeprefix("Dongles:")
    receivers = {address: (name, place) for address, (place, _, name) in json.loads(text).items()}
    columns = ["time", "receiver", "beacon", "rssi", "x", "y", "z"]
    parts = []
    for file in sorted(raw.glob("trk/*_all_sensors.mbd")):
        part = pd.read_csv(file, header=None, usecols=range(7), names=columns, dtype={"receiver": str})
        part = part[part["rssi"] < 0].sort_values("time", kind="stable")
        part["event"] = (part["time"].diff() > 0.1).cumsum()  # between two advertisements
        parts.append(part.assign(track=file.name.removesuffix("_all_sensors.mbd")))
    packets = pd.concat(parts)
    events = packets.groupby(["track", "event"], sort=False)
    position = events[["x", "y", "z"]].mean()
    rssi = packets.groupby(["track", "event", "receiver"])["rssi"].median().unstack()
    rssi = rssi.reindex(index=position.index, columns=list(receivers))
    rssi = rssi.mask(rssi <= NOT_DETECTED_DBM, -99.9)  # was received
    track = position.index.get_level_values("track")
    x = position["x"].to_numpy()
    splits = {
        "random": _random(len(x), round(0.2 * len(x))),
        "spatial": _parts(track.isin(["zigzagging_without_rotation", "straight_03"])),
        "block": _parts((x > 14.5) | ((x > 7.25) & (x < 10.25))),
    }
    names, places = zip(*receivers.values(), strict=True)
    _write_rssi(rssi.to_numpy(), position.to_numpy().round(4), names, list(places), splits, out)


def kolak(raw: Path, out: Path) -> None:
    """Write the calibration rows and then those of the robot's test run."""
    anchors = pd.read_csv(raw / "anchors.csv")
    files = ("calibration/calibration_df.csv", "tests/test_robot_df.csv")
    runs = [pd.read_csv(raw / file) for file in files]
    table = pd.concat(runs)
    position = table[["x", "y"]].to_numpy().round(4)
    cell = [tuple(row) for row in np.floor(position / 1.5).astype(int).tolist()]
    splits = {
        "random": _random(len(table), round(0.2 * len(table))),
        "spatial": _parts(np.arange(len(table)) >= len(runs[0])),
        "block": _parts(np.array([place in ((0, 4), (2, 2), (2, 4), (3, 3), (4, 4)) for place in cell])),
    }
    rssi = table[[f"rssi_{number}" for number in anchors["id"]]].to_numpy().round(3)
    names = [f"anchor{number}" for number in anchors["id"]]
    position = np.column_stack([position, np.full(len(table), 1.3)])  # height of the tag
    _write_rssi(rssi, position, names, anchors[["x", "y", "z"]].to_numpy(), splits, out)


def dcm(raw: Path, out: Path) -> None:
    """Write a survey table in which the router's positions are the receivers."""
    places = pd.read_csv(raw / "router_info.csv")
    name = places["Col"].astype(str) + places["Row"].astype(str)
    receivers = pd.DataFrame(
        {"receiver": "r" + name, "x": places["Original_X_Value"], "y": places["Original_Y_Value"], "z": 0.0}
    )
    columns = ["x", "y", "column", "row", "rssi"]
    parts = [
        pd.read_csv(file, sep=r"\s+", header=None, names=columns).assign(receiver=file.stem.replace("router_", "r"))
        for file in sorted(raw.glob("Dataset/router_*.txt"))
    ]
    survey = pd.concat(parts).assign(z=0.0)[["x", "y", "z", "receiver", "rssi"]]
    survey.to_csv(out / "survey.csv", index=False)
    receivers.sort_values("receiver").to_csv(out / "receivers.csv", index=False)


def lora(raw: Path, out: Path) -> None:
    """Write a survey table in metres about the gateway; on foot trains, by car tests."""
    latitude, longitude, altitude = LORA_GATEWAY
    walks = ("campus_walking_by_foot", "campus_by_car")
    parts = [pd.read_csv(next(raw.glob(f"{walk}/*_Full-Collected-data.csv"))) for walk in walks]
    table = pd.concat(parts)
    north, east = 110_574.0, 111_320.0  # of latitude, and of longitude at the equator
    survey = pd.DataFrame(
        {
            "x": ((table["Longitude"] - longitude) * east * np.cos(np.deg2rad(latitude))).round(2),
            "y": ((table["Latitude"] - latitude) * north).round(2),
            "z": (table["Altitude"] - altitude).round(2),
            "gw_rssi": table["GW RSSI"],
            "ed_rssi": table["ED RSSI"],
        }
    )
    survey.to_csv(out / "survey.csv", index=False)
    (out / "receivers.csv").write_text("receiver,x,y,z\ngw_rssi,0,0,0\ned_rssi,0,0,0\n")
    write_splits({"foot": _parts(np.arange(len(table)) >= len(parts[0]))}, out, first=0)


def fingerprints(raw: Path, out: Path) -> None:
    """Write training and test part of a set of fingerprints as one table, with the split `published` between them."""
    if files := [*raw.glob("original_datasets/*.mat")]:
        data = loadmat(files[0])["database"][0, 0]
        parts = [np.hstack([data[f"{part}Labels"][:, :4], data[f"{part}Macs"]]) for part in ("training", "test")]
    else:  # values before longitude, latitude, altitude, floor and building
        tables = [pd.read_csv(next(raw.glob(f"dataset/*/{part}.csv"))).to_numpy() for part in ("Train", "Test")]
        parts = [np.hstack([table[:, -5:-1], table[:, :-5]]) for table in tables]
    names = [f"WAP{number:03d}" for number in range(1, parts[0].shape[1] - 3)]
    table = pd.DataFrame(np.vstack(parts), columns=["x", "y", "z", "floor", *names])
    table.astype({"floor": int}).to_csv(out / "survey.csv", index=False)
    write_splits({"published": _parts(np.arange(len(table)) >= len(parts[0]))}, out, first=0)


def wifi_room(raw: Path, out: Path) -> None:
    """Write the mean RSSI of the packets at each point; points with fewer than 10 detected packets count as undetected."""
    (file,) = raw.glob("data/database_*_train.csv")
    room = file.stem.removeprefix("database_").removesuffix("_train")
    xs, ys, columns = WIFI_ACCESS_POINTS[room]
    means: list[pd.DataFrame] = []
    for part in ("train", "test"):
        table = pd.read_csv(raw / f"data/database_{room}_{part}.csv")
        rssi = table[[f"AP{number} RSS(dBm)" for number in columns]]
        grouped = rssi.where(rssi != -200).groupby([table["X"], table["Y"]])
        means.append(grouped.mean().where(grouped.count() >= 10))
    values = pd.concat(means)
    place = np.array(values.index.tolist())
    position = np.column_stack([place * WIFI_GRID_M, np.zeros(len(place))]).round(3)
    access_points = np.column_stack([xs, ys, np.zeros(len(xs))]) * WIFI_GRID_M
    names = [f"ap{number}" for number in range(1, len(xs) + 1)]
    splits = {"random": _parts(np.arange(len(values)) >= len(means[0]))}
    _write_rssi(values.to_numpy().round(2), position, names, access_points.round(3), splits, out)


def _write_rssi(rssi: Any, position: Any, names: Any, places: Any, splits: dict[str, Split], out: Path) -> None:
    data = Rssi(rssi, position, receiver_names=list(names), receiver_position=places, named_splits=splits)
    write_rssi(data, out)


def _parts(is_test: Mask) -> Split:
    """Return the training and the test rows of a mask."""
    return torch.from_numpy(np.flatnonzero(~is_test)), torch.from_numpy(np.flatnonzero(is_test))


def _random(count: int, n_test: int) -> Split:
    """Return a random split with seed 0."""
    is_test = np.zeros(count, dtype=bool)
    is_test[np.random.default_rng(0).permutation(count)[count - n_test :]] = True
    return _parts(is_test)
