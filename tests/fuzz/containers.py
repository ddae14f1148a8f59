"""Random files of the same measurements in other forms: what is read equals the plain form, or is refused as that is.

Forms are compressed tables, databases, ranked lists, logs that are joined by time, and channels in parts, pairs and
structs. Names, numbers and gaps are random, and texts are damaged in some of the attempts.
"""

from __future__ import annotations

import gzip
import random
import sqlite3
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from samples import snapshot_arrays, snapshots
from scipy.io import savemat

from fuzz.mutate import mutated
from swiftwrf import InputError, Rssi, load_rssi, load_snapshots

SNAPSHOTS = snapshots(n=12, count=2, side=2)
ADDRESS = "{:02x}:{:02x}:00:aa:{:02x}:{:02x}"


def compressed(suffix: str, draw: random.Random, folder: Path) -> None:
    """Read a table, damaged or not, as text and compressed."""
    content = walk(draw).to_csv(index=False).encode()
    if draw.random() < 0.7:
        content = mutated(content, draw, words_only=draw.random() < 0.5)
    (folder / "walk.csv").write_bytes(content)
    packed = folder / f"walk{suffix}"
    if suffix == ".zip":
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(draw.choice(["walk.csv", "export/Walk.CSV"]), content)
            archive.writestr("readme.txt", "x")
    else:
        packed.write_bytes(gzip.compress(content))
    check_equal(outcome(folder / "walk.csv"), outcome(packed))


def database(known: str, draw: random.Random, folder: Path) -> None:
    """Read random observations, some without power or address, from a database; some databases are damaged."""
    n, receivers = draw.randint(12, 40), names(draw, 3)
    rows = []
    for number in range(n):
        for receiver in receivers:
            power = draw.choice([draw.randint(-90, -40)] * 5 + [None if known == "location" else 0])
            rows.append((1.7e9 + number, receiver, power, 48 + 1e-4 * number, 11 + 1e-4 * draw.randint(0, 9), 400.0))
    table = pd.DataFrame(rows, columns=["time", "bssid", "rssi", "lat", "lon", "altitude"])
    table["lon"] = table.groupby("time").lon.transform("first")
    file = folder / "log.sqlite"
    with sqlite3.connect(file) as base:
        if known == "location":
            stored = table.rename(columns={"rssi": "level"}).assign(accuracy=4.0)
            stored["time"] = (1000 * stored.time).astype("int64")
        else:
            stored = table.rename(columns={"bssid": "transmac", "rssi": "signal", "altitude": "alt"})
            stored = stored.assign(ts_sec=stored.time.astype(int), ts_usec=0, frequency=2437000).drop(columns="time")
        stored.to_sql(known, base, index=False)
    base.close()
    if draw.random() < 0.4:
        file.write_bytes(mutated(file.read_bytes(), draw))
        outcome(file)  # a value that changed is right as it stands
        return
    powers = (
        table.assign(rssi=table.rssi.mask(table.rssi == 0))
        .pivot(index="time", columns="bssid", values="rssi")
        .astype(float)
    )
    check_powers(load_rssi(file, filler=[]), powers if known == "location" else powers.dropna(how="all"))


def ranked(draw: random.Random, folder: Path) -> None:
    """Read a walk as lists of the strongest receivers in numbered columns, and as one column a receiver."""
    receivers = names(draw, draw.randint(4, 7))
    entries = draw.randint(2, len(receivers) - 1)
    table = walk(draw, receivers)
    prefix, name, power = draw.choice(
        [("ap", "bssid", "rssi"), ("ncell", "pci", "rsrp"), ("wifi_", "mac", "signal"), ("bt", "address", "level")]
    )
    if name == "pci":
        table = table.rename(columns={receiver: str(100 + k) for k, receiver in enumerate(receivers)})
        receivers = [str(100 + k) for k in range(len(receivers))]
    lists, kept = table[["x", "y"]].copy(), table[["x", "y"]].copy()
    kept[receivers] = np.nan
    columns: dict[str, list[object]] = {}
    for row, values in enumerate(table[receivers].to_numpy()):
        order = np.argsort(-values, kind="stable")[: draw.randint(1, entries) if draw.random() < 0.2 else entries]
        for place in range(entries):
            known = place < len(order)
            columns.setdefault(f"{prefix}{place + 1}_{name}", []).append(receivers[order[place]] if known else "")
            columns.setdefault(f"{prefix}{place + 1}_{power}", []).append(values[order[place]] if known else "")
        kept.loc[row, [receivers[at] for at in order]] = values[order]
    lists = lists.assign(**columns)
    lists.to_csv(folder / "lists.csv", index=False)
    data = load_rssi(folder / "lists.csv", filler=[])
    check_powers(data, kept[receivers].dropna(axis=1, how="all"))
    np.testing.assert_allclose(data.transmitter_position[:, :2], table[["x", "y"]])


def logs(draw: random.Random, folder: Path) -> None:
    """Join a track and scans with clocks of random zones; each scan lies where the walk was at its time."""
    start = pd.Timestamp("2026-03-01") + pd.Timedelta(seconds=draw.randint(0, 10**7))
    every, zone_h = draw.choice([0.5, 1.0, 2.0]), draw.choice([0, 0, 1, 2, -5, 5.5, -9.5, 12, 5.75])
    seconds = np.arange(0, draw.randint(60, 300), every)
    gap = draw.choice([None, (30.0, 55.0)])
    seconds = seconds if gap is None else seconds[(seconds < gap[0]) | (seconds > gap[1])]

    def place(t: np.ndarray) -> np.ndarray:
        return np.column_stack([1.1 * t, 20 + 5 * np.sin(t / 9)])

    track = pd.DataFrame(place(seconds), columns=["x", "y"]).assign(time=start + pd.to_timedelta(seconds, unit="s"))
    at = np.arange(seconds[0] + 0.3, seconds[-1], draw.choice([2.0, 3.0]))
    receivers = names(draw, 2)
    scans = pd.DataFrame({"timestamp": np.repeat(start + pd.to_timedelta(at + 3600 * zone_h, unit="s"), 2)})
    scans = scans.assign(bssid=receivers * len(at), rssi=[-40 - k % 37 for k in range(2 * len(at))])
    form = draw.choice(["iso", "epoch", "milliseconds"])
    for table, name, column in ((track, "track.csv", "time"), (scans, "scan.csv", "timestamp")):
        if form != "iso":
            since = (table[column] - pd.Timestamp(0)).dt.total_seconds()
            table = table.assign(**{column: since if form == "epoch" else (1000 * since).round().astype("int64")})
        table.to_csv(folder / name, index=False)
    data = load_rssi(folder, filler=[])
    in_gap = np.diff(seconds)[np.searchsorted(seconds, at) - 1] > 10
    expected = np.column_stack([np.interp(at, seconds, column) for column in place(seconds).T])[~in_gap]
    np.testing.assert_allclose(data.transmitter_position[:, :2], expected, atol=2e-3)
    assert data.rssi_dbm[0].tolist() == [-40.0, -41.0]


def channels(form: str, draw: random.Random, folder: Path) -> None:
    """Read channels in two arrays, as pairs of numbers or in a struct; or with a wrong shape."""
    arrays = dict(snapshot_arrays(SNAPSHOTS))
    csi = np.asarray(arrays.pop("csi")) * draw.choice([1.0, 0.01, 300.0])
    expected, prefix, wrong = csi, draw.choice(["csi_", "CSI_", "h_", "channel_", "csi"]), draw.random() < 0.2
    if form == "polar":
        unit, scale = draw.choice([("", 1.0), ("_rad", 1.0), ("_deg", 180 / np.pi), ("_degrees", 180 / np.pi)])
        parts = {prefix + draw.choice(["abs", "amplitude", "mag"]): np.abs(csi)}
        parts |= {prefix + draw.choice(["angle", "phase"]) + unit: np.angle(csi) * scale}
    elif form == "cartesian":
        first, second = draw.choice([("real", "imag"), ("re", "im"), ("i", "q"), ("Real", "Imag")])
        parts = {prefix + first: csi.real, prefix + second: csi.imag}
    elif form == "pairs":
        scaled = csi * 100 / max(np.abs(csi.real).max(), np.abs(csi.imag).max())
        pairs = np.stack([scaled.real, scaled.imag], axis=-1)
        pairs = pairs.round().astype(draw.choice(["i1", "i2", "f4"]))
        expected = pairs[..., 0] + 1j * pairs[..., 1]
        parts = {"csi": pairs if draw.random() < 0.5 else pairs.reshape(*csi.shape[:-1], -1)}
    else:
        parts = {"csi": csi}
    if wrong:
        name = draw.choice(list(parts))
        parts[name] = parts[name][: draw.randint(0, len(csi) - 1)]
    if form == "struct":
        savemat(folder / "snapshots.mat", {draw.choice(["data", "s", "measurement"]): parts | arrays})
    else:
        np.savez(folder / "snapshots.npz", **parts, **arrays)
    if wrong:
        try:
            load_snapshots(folder)
        except InputError:
            return
        raise AssertionError(f"{name} with {len(parts[name])} of {len(csi)} rows is accepted")
    found = load_snapshots(folder).channel.numpy()
    scale = [np.abs(values).max(axis=(1, 2), keepdims=True) for values in (found, expected)]  # the reader scales rows
    np.testing.assert_allclose(found / scale[0], expected / scale[1], rtol=1e-4, atol=1e-5)


def walk(draw: random.Random, receivers: list[str] | None = None) -> pd.DataFrame:
    """Return a table of random positions and RSSI, one column a receiver."""
    n, receivers = draw.randint(30, 60), receivers or names(draw, draw.randint(2, 5))
    table = pd.DataFrame({axis: [round(draw.uniform(0, 30), 2) for _ in range(n)] for axis in "xy"})
    return table.assign(**{name: [float(draw.randint(-85, -40)) for _ in range(n)] for name in receivers})


def names(draw: random.Random, count: int) -> list[str]:
    """Return different addresses."""
    return [
        ADDRESS.format(2 * draw.randint(1, 127), draw.randint(0, 255), draw.randint(0, 255), k) for k in range(count)
    ]


def outcome(file: Path) -> Rssi | InputError:
    """Return what is read, or the refusal."""
    try:
        return load_rssi(file)
    except InputError as refusal:
        return refusal


def check_equal(plain: Rssi | InputError, packed: Rssi | InputError) -> None:
    """Raise AssertionError unless both are equal, and InputError if both are refused.

    Raises:
        AssertionError: Different measurements, or one of them is refused.
        InputError: Both are refused.
    """
    if isinstance(plain, InputError) and isinstance(packed, InputError):
        raise packed
    assert isinstance(plain, Rssi), f"only the plain text is refused: {plain}"
    assert isinstance(packed, Rssi), f"only the other form is refused: {packed}"
    assert plain.receiver_names == packed.receiver_names
    np.testing.assert_array_equal(plain.rssi_dbm, packed.rssi_dbm)
    np.testing.assert_array_equal(plain.transmitter_position, packed.transmitter_position)


def check_powers(data: Rssi, expected: pd.DataFrame) -> None:
    """Raise AssertionError unless the RSSI of each receiver is the expected one."""
    assert {*data.receiver_names} == {*expected.columns}
    np.testing.assert_array_equal(data.rssi_dbm, expected[list(data.receiver_names)].to_numpy())


ATTEMPTS: dict[str, Callable[[random.Random, Path], None]] = {
    **{f"table in {suffix}": partial(compressed, suffix) for suffix in (".csv.gz", ".zip")},
    **{f"database with {known}": partial(database, known) for known in ("location", "packets")},
    "ranked lists": ranked,
    "logs joined by time": logs,
    **{f"channels, {form}": partial(channels, form) for form in ("polar", "cartesian", "pairs", "struct")},
}
