"""Data sets from arrays and tables: what they compute, print and refuse; readers from other packages."""

import errno
import importlib
import math
import os
import sys

import numpy as np
import pandas as pd
import pytest
import torch
from samples import install, write_captures

from swiftwrf import (
    AngularGrid,
    ArrayPose,
    InputError,
    Rssi,
    Snapshots,
    Spectra,
    datasets,
    load_rssi,
    load_spectra,
    rssi_room,
    simulated_room,
)
from swiftwrf.array import planar
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data import load_snapshots
from swiftwrf.data.formats import SPECTRA_FORMATS
from swiftwrf.data.rssi import Offsets
from swiftwrf.runtime import durable

ROOM = simulated_room(n=24, grid=AngularGrid.hemisphere(9, 36))
FACING_X = ArrayPose((0.1, 2.4, 1.2), (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)))
CONVERTED = {"tensors": lambda t: t, "arrays": lambda t: t.numpy(), "lists": lambda t: t.tolist()}


@pytest.mark.parametrize("kind", CONVERTED)
def test_spectra_from_arrays_are_those_of_the_room(kind):
    to = CONVERTED[kind]
    data = Spectra(to(ROOM.spectrum), to(ROOM.position), array=ROOM.array, pose=FACING_X, name="own")
    torch.testing.assert_close(data.spectrum, ROOM.spectrum)
    torch.testing.assert_close(data.label, ROOM.label)
    assert torch.equal(data.fixed_position, ROOM.fixed_position)
    assert (data.grid, data.moving, len(data.split()[0])) == (ROOM.grid, "transmitter", 19)
    assert torch.equal(data.index, torch.arange(24))
    assert data.line_of_sight.all()


def test_the_pose_of_a_moving_array_is_its_orientation():
    room = simulated_room(n=12, moving="receiver", grid=ROOM.grid)
    level = ArrayPose((0.0, 0.0, 0.0))
    data = Spectra(room.spectrum, room.position, pose=level, moving="receiver", fixed_position=(3.0, 2.5, 2.7))
    torch.testing.assert_close(data.label, room.label)
    unknown = Spectra(room.spectrum, room.position, pose=level, moving="receiver")
    assert unknown.label.isnan().all()
    with pytest.raises(InputError, match="direction at synthetic positions is unknown"):
        unknown.direction_at(room.position)


def test_bytes_of_images_count_255_as_1():
    data = Spectra((255 * ROOM.spectrum).round().byte().numpy(), ROOM.position.float())
    assert data.store.values.dtype == torch.uint8
    torch.testing.assert_close(data.spectrum, ROOM.spectrum, rtol=0, atol=0.5 / 255)


def test_snapshots_from_arrays():
    array = PlanarArray.grid(2, 2, 0.06, 2.4e9)
    channel = torch.polar(torch.ones(20, 4), torch.rand(20, 4)).numpy()
    data = Snapshots(channel, torch.rand(20, 3), array=array, pose=FACING_X, time=range(20))
    assert data.channel.shape == (20, 1, 4)
    spectra = data.spectra(ROOM.grid)
    torch.testing.assert_close(spectra.label, spectra.direction_at(data.position))
    assert data.subset(torch.tensor([3, 1])).time.tolist() == [3, 1]
    assert repr(data).startswith(
        "<Snapshots 'snapshots': 20 channels of 1 snapshots, 4 elements at 2.4 GHz,\n positions over"
    )


@pytest.mark.parametrize(
    ("rows", "numbers"),
    [
        (slice(3), [0, 1, 2]),
        ([5, -1], [5, 23]),
        (np.array([4, 2]), [4, 2]),
        (torch.arange(24) > 21, [22, 23]),
        ([False] * 23 + [True], [23]),
        ([], []),
    ],
)
@pytest.mark.parametrize("data", [ROOM, rssi_room(n=24)], ids=["spectra", "RSSI"])
def test_rows_by_slice_list_and_mask(data, rows, numbers):
    assert data[rows].index.tolist() == data.subset(rows).index.tolist() == numbers
    assert len(data[rows]) == len(numbers)


def test_data_hold_no_gradient():
    position = torch.rand(20, 3, requires_grad=True)
    rssi = torch.full((20, 1), -50.0, requires_grad=True)
    data = Rssi(rssi, position, receiver_position=position[:1].detach())
    assert not data.rssi_dbm.requires_grad
    assert not data.transmitter_position.requires_grad
    assert not Spectra(torch.rand(20, 9, 36, requires_grad=True), position).spectrum.requires_grad


def test_corrected_rssi_may_leave_the_range_of_received_powers():
    offsets = Offsets("device", "a", {"b": -60.0}, 0.5)
    data = Rssi([[-20.0], [-20.0]], torch.rand(2, 3), groups=pd.Series(["a", "b"], name="device"))
    assert offsets.removed(data).subset([1]).rssi_dbm.tolist() == [[40.0]]


def test_rssi_from_a_table_and_back():
    data = rssi_room(n=30)
    places = dict(zip(data.receiver_names, data.receiver_position.tolist(), strict=True))
    back = Rssi.from_frame(data.to_frame(), receiver_position=places)
    assert back.receiver_names == data.receiver_names
    assert torch.equal(back.rssi_dbm.nan_to_num(), data.rssi_dbm.nan_to_num())
    assert torch.equal(back.transmitter_position, data.transmitter_position)
    assert torch.equal(back.receiver_position, data.receiver_position)
    some = Rssi.from_frame(data.to_frame(), receiver_position={"receiver01": (0, 0, 0)})
    assert some.receiver_located.tolist() == [True] + [False] * 11


def test_tables_and_one_line_of_a_data_set():
    frame = ROOM.subset(torch.tensor([5, 2])).to_frame()
    assert frame.index.tolist() == [5, 2]
    assert list(frame) == ["x_m", "y_m", "z_m", "azimuth_deg", "elevation_deg", "line_of_sight"]
    assert frame.loc[2, "azimuth_deg"] == pytest.approx(math.degrees(ROOM.label[2, 0]))
    assert repr(ROOM) == (
        "<Spectra 'simulated-room': 24 spectra of 9 x 36 directions, 16 elements at 0.915 GHz, moving transmitter,\n "
        f"positions over {' x '.join(f'{s:.2f}' for s in np.ptp(ROOM.position.numpy(), axis=0))} m>"
    )
    assert "30 rows at 12 receivers" in repr(rssi_room(n=30))


READER = """
import torch
from swiftwrf import Spectra
from swiftwrf.data.formats import Format

class Saved(Format):
    def recognises(self, path):
        return path.suffix == ".pt"
    def read(self, path, options):
        content = torch.load(path, weights_only=True)
        return Spectra(content["spectra"], content["position"], name=path.stem)
"""


def test_a_reader_comes_from_another_package(tmp_path, monkeypatch):
    (tmp_path / "saved_reader.py").write_text(READER)
    install(tmp_path, "swiftwrf.readers.spectra", saved="saved_reader:Saved")
    torch.save({"spectra": ROOM.spectrum, "position": ROOM.position}, tmp_path / "room.pt")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(SPECTRA_FORMATS, "_registered", dict(SPECTRA_FORMATS._registered))
    importlib.invalidate_caches()
    data = load_spectra(tmp_path / "room.pt")
    torch.testing.assert_close(data.spectrum, ROOM.spectrum)
    assert "saved" in SPECTRA_FORMATS
    with pytest.raises(InputError, match="read as saved, which takes no grid"):
        load_spectra(tmp_path / "room.pt", grid=ROOM.grid)


@pytest.mark.parametrize(
    ("module", "extra", "use"),
    [
        ("h5py", "formats", lambda folder: load_snapshots(write_empty(folder / "snapshots.h5"))),
        ("pyarrow.parquet", "formats", lambda folder: load_rssi(write_empty(folder / "walk.parquet"))),
        ("csiread", "csi", lambda folder: (write_captures(folder), load_snapshots(folder))),
        ("xarray", "xarray", lambda folder: ROOM.to_xarray()),
        ("pooch", "data", lambda folder: datasets.fetch("kolak")),
    ],
)
def test_a_missing_library_is_named_with_its_extra(tmp_path, monkeypatch, module, extra, use):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("SWIFTWRF_DATA", raising=False)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"pip install 'swiftwrf-tasks\[{extra}\]'"):
        use(tmp_path)


def write_empty(file):
    file.touch()
    return file.parent


def test_what_is_cached_is_bounded_in_bytes(monkeypatch):
    array, small, large = PlanarArray.square(2, 1e9), AngularGrid.hemisphere(10, 40), AngularGrid.hemisphere(40, 160)
    monkeypatch.setattr(planar, "MAX_CACHED_VALUES", 10_000)
    assert planar.basis(array, small) is planar.basis(array, small)
    assert planar.basis(array, large) is not planar.basis(array, large)


@pytest.mark.parametrize(("code", "ignored"), [(errno.EINVAL, True), (errno.ENOTSUP, True), (errno.EIO, False)])
def test_file_systems_that_cannot_sync_a_directory(tmp_path, monkeypatch, code, ignored):
    def fsync(descriptor):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", fsync)
    if ignored:
        durable.write_text(tmp_path / "a", "text")
        assert (tmp_path / "a").read_text() == "text"
    else:
        with pytest.raises(OSError, match=os.strerror(code)):
            durable.write_text(tmp_path / "a", "text")
