"""Files of several stations: a folder for each, csi of several arrays, and the join of their transmissions."""

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import swiftwrf
from swiftwrf import InputError, Stations, load_stations
from swiftwrf.data.formats.stations import station_names
from swiftwrf.data.simulated import OFFICE, STATIONS
from swiftwrf.data.writing import write_spectra

GRID = swiftwrf.AngularGrid.hemisphere(9, 36)
HALF_M = 0.0614  # half a wavelength at 2.44 GHz


def written(spectra: swiftwrf.Spectra, folder: Path) -> None:
    folder.mkdir()
    write_spectra(spectra, folder)


@pytest.fixture
def csi(tmp_path: Path) -> tuple[Path, np.ndarray, np.ndarray]:
    """A folder of channels (n, 2, K) of two arrays, of which the second did not receive rows 3 and 7."""
    random = np.random.default_rng(0)
    position = random.uniform((2, 1, 1), (6, 5, 1.5), (30, 3))
    channel = random.normal(size=(30, 2, 16)) + 1j * random.normal(size=(30, 2, 16))
    channel[[3, 7], 1] = np.nan
    np.savez(tmp_path / "snapshots.npz", csi=channel, position=position)
    arrays = [
        {"name": name, "array_position": list(pose.position), "array_orientation": list(pose.orientation)}
        for name, pose in list(STATIONS.items())[:2]
    ]
    common = {"frequency_hz": OFFICE.frequency_hz, "rows": 4, "columns": 4, "spacing_m": HALF_M}
    (tmp_path / "stations.yml").write_text(yaml.safe_dump(common | {"stations": arrays}))
    return tmp_path, channel, position


def test_csi_of_several_arrays(csi):
    folder, channel, position = csi
    assert station_names(folder) == ["west", "east"]
    data = load_stations(folder, grid=GRID)
    assert data.received.sum(dim=0).tolist() == [30, 28]
    assert not data.received[[3, 7], 1].any()
    assert np.allclose(data.position, position)
    rows, spectra = data.of("east")
    expected = channel[rows, 1] / np.sqrt((np.abs(channel[rows, 1]) ** 2).mean(axis=1, keepdims=True))
    assert np.allclose(spectra.channel[:, 0], expected, atol=1e-5)
    assert spectra.fixed_position.tolist() == list(STATIONS["east"].position)
    one = swiftwrf.load_spectra(folder, grid=GRID, station=2)
    assert one.index.equal(spectra.index)
    assert one.spectrum.equal(spectra.spectrum)


def test_folders_of_stations(tmp_path):
    data = swiftwrf.simulated_stations(n=20, stations=2, grid=GRID)
    for name in data.names:
        written(data.of(name)[1], tmp_path / name)
    found = load_stations(tmp_path)
    assert found.names == ["east", "west"]
    assert found.position.allclose(data.position, atol=1e-6)
    assert found.received.all()


def test_rows_are_joined_by_position(tmp_path):
    data = swiftwrf.simulated_stations(n=20, stations=2, grid=GRID)
    written(data.of("west")[1][5:], tmp_path / "west")
    written(data.of("east")[1][:12].subset(torch.arange(12).flip(0)), tmp_path / "east")
    found = load_stations(tmp_path)
    assert len(found) == 20
    both = found.received.all(dim=1)
    assert int(both.sum()) == 7
    west, east = (found.only(name)[both].of(name)[1] for name in ("west", "east"))
    assert west.position.allclose(east.position, atol=1e-6)
    assert {tuple(p) for p in found.position[both].round(decimals=4).tolist()} == {
        tuple(p) for p in data.position[5:12].round(decimals=4).tolist()
    }


def test_packet_numbers_join_repeated_positions(tmp_path):
    data = swiftwrf.simulated_stations(n=20, stations=2, grid=GRID)
    west, east = (data.of(name)[1] for name in data.names)
    written(west[[0, 1, 2, 0, 3, 4, 5, 6, 7, 8, 9, 10]], tmp_path / "west")
    written(east[[0, 2, 0, 3, 4, 5, 6, 7, 8, 9, 10]], tmp_path / "east")
    with pytest.raises(InputError, match=r"give the number of each transmission in packets\.txt"):
        load_stations(tmp_path)
    (tmp_path / "west" / "packets.txt").write_text("\n".join(map(str, range(100, 112))))
    with pytest.raises(InputError, match=r"east.packets\.txt is missing"):
        load_stations(tmp_path)
    (tmp_path / "east" / "packets.txt").write_text("\n".join(map(str, (100, 102, 103, *range(104, 112)))))
    found = load_stations(tmp_path)
    assert found.index.tolist() == list(range(100, 112))
    assert found.received[:, found.names.index("east")].tolist() == [number != 101 for number in range(100, 112)]


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (
            lambda folder: (folder / "stations.yml").write_text("stations: [west, east]"),
            "a list of arrays, each with its name",
        ),
        (lambda folder: (folder / "stations.yml").unlink(), "has no stations"),
        (
            lambda folder: _csi(folder, (30, 3, 16)),
            r"csi must have shape \(n, 2, \[subcarriers or packets,\] elements\)",
        ),
        (lambda folder: _csi(folder, (30, 2, 16), 0.0), "received nothing"),
    ],
)
def test_refusals(csi, damage, words):
    folder, _, _ = csi
    damage(folder)
    with pytest.raises(InputError, match=words):
        load_stations(folder, grid=GRID)


def _csi(folder: Path, shape: tuple[int, ...], factor: float = 1.0) -> None:
    position = np.load(folder / "snapshots.npz")["position"]
    values = np.ones(shape, dtype=np.complex128)
    values[:, 1] *= factor
    np.savez(folder / "snapshots.npz", csi=values, position=position)


def test_stations_need_measurements_of_each():
    with pytest.raises(InputError, match="one station or more"):
        Stations({})
