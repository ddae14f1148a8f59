"""Data sets from arrays and tables: what they compute, print and refuse; readers from other packages."""

import errno
import importlib
import math
import os
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from samples import install

from swiftwrf import (
    AngularGrid,
    ArrayPose,
    InputError,
    Rssi,
    Snapshots,
    Spectra,
    load_spectra,
    rssi_room,
    simulated_room,
)
from swiftwrf.array import planar
from swiftwrf.array.planar import PlanarArray
from swiftwrf.data import load_snapshots
from swiftwrf.data.formats import SPECTRA_FORMATS
from swiftwrf.data.raytraced import Tracing
from swiftwrf.data.rssi import Offsets
from swiftwrf.data.simulated import ShoeboxRoom
from swiftwrf.data.splits import folds
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


NAN_POSITION = ROOM.position.where(torch.arange(24)[:, None] != 3, torch.nan)
FOUR = PlanarArray.square(2, 1e9)


def of_spectra(values=ROOM.spectrum, position=ROOM.position, **options):
    return lambda: Spectra(values, position, **options)


def of_room(**changes):
    return lambda: replace(ROOM, **changes)


def of_snapshots(channel, **options):
    return lambda: Snapshots(channel, torch.rand(5, 3), array=FOUR, **options)


def of_rssi(values, position=((0, 0, 0),), **options):
    return lambda: Rssi(values, position, **options)


WRONG = {
    "other number of positions": (of_spectra(position=ROOM.position[:5]), "5 positions, but store has 24"),
    "flat spectra": (of_spectra(ROOM.spectrum[0]), r"spectra must have shape \(n, n, n\)"),
    "decibels": (of_spectra(-20 * ROOM.spectrum), r"magnitudes in \[0, 1\]"),
    "a spectrum is nan": (of_spectra(ROOM.spectrum * torch.nan), "spectra must be finite; row 0"),
    "a position is nan": (of_spectra(position=NAN_POSITION), "position must be finite; row 3"),
    "positions in a plane": (of_spectra(position=ROOM.position[:, :2]), r"position must have shape \(n, 3\)"),
    "text": (of_spectra(position=[["a", "b", "c"]] * 24), "position must be numbers"),
    "labels of others": (of_room(label=ROOM.label[:7]), "label has 7 rows"),
    "labels of one angle": (of_spectra(label=ROOM.label[:, 0]), "label must have shape"),
    "visibility of others": (of_room(line_of_sight=torch.ones(3)), "line_of_sight has 3 rows"),
    "another end": (of_spectra(moving="reciever"), "moving must be 'transmitter' or"),
    "another grid": (of_spectra(grid=AngularGrid.hemisphere(9, 30)), "do not fit a grid"),
    "pose twice": (of_spectra(pose=FACING_X, fixed_position=(0, 0, 0)), "leave them out"),
    "at the array": (
        of_spectra(pose=ArrayPose((*ROOM.position[2].tolist(),))),
        "position 2 of spectra is that of the fixed end",
    ),
    "a field of others": (of_spectra(colour="red"), "Spectra has no colour"),
    "no positions": (lambda: Spectra(ROOM.spectrum), "spectra and their positions"),
    "a split of others": (
        of_room(named_splits={"day": (torch.arange(20), torch.tensor([24]))}),
        "'day' .* outside 0 to 23",
    ),
    "no pose": (of_snapshots(torch.ones(5, 4).cfloat()), "needs the pose"),
    "other elements": (of_snapshots(torch.ones(5, 3).cfloat(), pose=FACING_X), r"channel must have shape \(5, 4\)"),
    "real channels": (of_snapshots(torch.ones(5, 4), pose=FACING_X), "channel must be complex64 numbers"),
    "channels beyond their type": (of_snapshots(np.full((5, 4), 1e300j), pose=FACING_X), "channel must be finite"),
    "complex spectra": (of_spectra(ROOM.spectrum + 0j), "spectra must be real"),
    "masked spectra": (of_spectra(np.ma.masked_less(ROOM.spectrum, 0.1)), "has masked values"),
    "spectra of truth values": (of_spectra(ROOM.spectrum > 0.5), "must be float32 numbers"),
    "complex positions": (of_spectra(position=ROOM.position + 0j), "position must be real"),
    "a position far away": (of_spectra(position=1e9 * ROOM.position), "position must be .* at most 1e.09; row 0"),
    "a far end": (of_spectra(fixed_position=(0, 0, 1e300)), "fixed_position must be .* at most 1e.09"),
    "partly visible": (of_room(line_of_sight=[0.3] * 24), "line_of_sight must be True or False, got 0.3"),
    "labels in degrees": (of_room(label=torch.full((24, 2), 200.0)), "convert degrees by deg2rad"),
    "infinite labels": (of_room(label=torch.full((24, 2), math.inf)), "label must be finite, or nan"),
    "half an index": (of_room(index=torch.arange(24) + 0.5), "index must be whole numbers, got 0.5"),
    "a stretched rotation": (of_room(rotation=2 * torch.eye(3)), "must be a rotation matrix"),
    "a mirrored rotation": (of_room(rotation=-torch.eye(3)), "must be a rotation matrix"),
    "infinite RSSI": (of_rssi([[-math.inf]]), "rssi_dbm must be finite, or nan"),
    "RSSI of others": (of_rssi([[-50.0]] * 3, torch.rand(4, 3)), "4 positions, but rssi_dbm has 3 rows"),
    "one name for two": (of_rssi([[-50.0, -60]], receiver_names=["a", "a"]), "2 receivers, but the names"),
    "path loss for RSSI": (of_rssi([[-50.0], [60.0]], torch.rand(2, 3)), "row 2, receiver receiver1: 60 dBm"),
    "RSSI of a filler": (of_rssi([[-99999.0]]), "-99999 dBm is no received power"),
    "RSSI of truth values": (of_rssi([[True]]), "rssi_dbm must be float64 numbers"),
    "complex RSSI": (of_rssi([[-50j]]), "rssi_dbm must be real"),
    "masked RSSI": (of_rssi(np.ma.masked_values([[-50.0, 100.0]], 100.0)), "has masked values"),
    "far RSSI": (of_rssi([[-50.0]], [[0, 0, 2e9]]), "transmitter_position must be .* at most 1e.09"),
    "a far receiver": (
        of_rssi([[-50.0]], receiver_position=[[2e9, 0, 0]]),
        "receiver_position must be .* at most 1e.09",
    ),
    "complex receivers": (of_rssi([[-50.0]], receiver_position=[[1j, 0, 0]]), "receiver_position must be real"),
    "an infinite time": (of_rssi([[-50.0]], time=[math.inf]), "time must be finite, or nan"),
    "names in one text": (of_rssi([[-50.0, -60]], receiver_names="ab"), "must be a list, of which each is a text"),
    "an empty name": (of_rssi([[-50.0]], receiver_names=[" "]), "must be a list of texts"),
    "a number as name": (of_rssi([[-50.0]], receiver_names=[1]), "must be a list, of which each is a text"),
    "two lines as name": (of_rssi([[-50.0]], receiver_names=["a\r\nb"]), "must be a list of texts"),
    "half a place": (
        of_rssi([[-50.0, -60]], receiver_position=[[0, 0, 0], [0, 0, math.nan]]),
        "nan where it is unknown; row 1",
    ),
    "half a seed": (lambda: ROOM.split("block", 0.5), "seed must be a whole number at least 0, got 0.5"),
    "a seed of text": (lambda: rssi_room(n=20).split(seed="a"), "seed must be a whole number"),
    "a row beyond the last": (lambda: ROOM.subset([24]), "rows of simulated-room must be a list of numbers below 24"),
    "a mask of others": (lambda: ROOM.subset(torch.ones(10, dtype=torch.bool)), "a mask of that length"),
    "half a row": (lambda: ROOM[[0.5]], "a list of numbers below 24"),
    "one row": (lambda: ROOM[3], "must be a list of numbers"),
}


@pytest.mark.parametrize("name", WRONG)
def test_refuses_arrays(name):
    make, says = WRONG[name]
    with pytest.raises(InputError, match=says):
        make()


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
    long = pd.DataFrame({"x": [0, 0, 1], "y": 0, "z": 1, "receiver": ["a", "b", "a"], "rssi": [-50, -60, -70]})
    assert Rssi.from_frame(long).rssi_dbm.nan_to_num(0).tolist() == [[-50, -60], [-70, 0]]
    with pytest.raises(InputError, match="the table row 2, receiver a: 40 dBm"):
        Rssi.from_frame(pd.DataFrame({"x": [0, 1, 2], "y": 0, "a": [-50, 40, -60]}))


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


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: simulated_room(moving="reciever"), "moving must be"),
        (lambda: simulated_room(n=0), "n must be a whole number at least 1"),
        (lambda: simulated_room(phase_noise=-1.0), "phase_noise must be"),
        (lambda: rssi_room(n=-1), "n must be"),
        (lambda: folds(ROOM.position, "blok", 0), "validation must be 'random' or 'block'"),
        (lambda: load_spectra("x", every=0), "every must be"),
        (lambda: load_snapshots("x", station=-1), "station must be"),
        (lambda: Tracing(order=-1), "order must be"),
        (lambda: PlanarArray.square(0, 1e9), "side must be a whole number at least 1"),
        (lambda: PlanarArray.square(4, 0), "frequency_hz must be a number above 0"),
        (lambda: PlanarArray.square(4, 1e9, spacing=-1.0), "spacing must be a number above 0"),
        (lambda: PlanarArray.grid(2.5, 2, 0.1, 1e9), "rows must be a whole number"),
        (lambda: PlanarArray.grid(2, 2, 0.0, 1e9), "spacing must be a number above 0"),
        (lambda: PlanarArray([[0.0, 1j]], 1.0), "element must be real"),
        (lambda: PlanarArray([[0.0, 0.0]], "1 m"), "wavelength must be a number above 0"),
        (lambda: AngularGrid.hemisphere(10, 40.0), "n_azimuth must be a whole number"),
        (lambda: AngularGrid.hemisphere(0, 40), "n_elevation must be a whole number at least 2"),
        (lambda: ArrayPose((0.0, 1.0)), r"position must have shape \(3\), got \(2,\)"),
        (lambda: ShoeboxRoom(size=(0.0, 1.0, 1.0)), "size must be"),
    ],
)
def test_declared_ranges_are_checked(call, says):
    with pytest.raises(InputError, match=says):
        call()


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
