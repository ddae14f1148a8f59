"""DICHASUS and ESPARGOS: records without TensorFlow, arrays seen from the front, offsets, and what is refused."""

import numpy as np
import pytest
import torch
from samples import record_source, tensor_message, write_dichasus, write_espargos, write_records

from swiftwrf import AngularGrid, InputError, load_snapshots, load_spectra
from swiftwrf.array.angles import angular_distance, to_direction
from swiftwrf.contrib.formats.records import records, tensor

GRID = AngularGrid.hemisphere(45, 180)


@pytest.mark.parametrize("dtype", ["f4", "f8", "c8"])
def test_records_come_back(tmp_path, dtype):
    values = (np.arange(400).reshape(2, 200) * (1 + 1j)).real.astype(dtype)
    write_records(tmp_path / "a.tfrecords", [{"csi": values, "pos": np.zeros(3)}] * 3)
    read = list(records(tmp_path / "a.tfrecords"))
    assert len(read) == 3
    np.testing.assert_array_equal(tensor(read[2]["csi"]), values)


@pytest.mark.parametrize("at", [3, 9, 40, -2])
def test_a_flipped_bit_is_refused(tmp_path, at):
    """In the length, its checksum, the data, and their checksum."""
    file = tmp_path / "a.tfrecords"
    write_records(file, [{"pos": np.zeros(3)}])
    content = bytearray(file.read_bytes())
    content[at] ^= 1
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"checksum does not match|ends within record 1"):
        list(records(file))


def test_a_tensor_of_another_size_than_it_claims():
    message = tensor_message(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="with 6 numbers"):
        tensor(message.replace(b"\x12\x02\x08\x03", b"\x12\x02\x08\x04"))


def peaks_follow(data):
    peak = data.grid.direction.flatten(0, 1)[data.spectrum.flatten(1).argmax(1)]
    return float(angular_distance(peak, to_direction(*data.label.unbind(-1))).rad2deg().median())


def test_espargos(tmp_path):
    data = load_snapshots(write_espargos(tmp_path / "lab"))
    made = record_source((2, 4))
    assert (data.name, data.channel.shape) == ("lab-A", (24, 3, 8))
    torch.testing.assert_close(data.rotation, made.rotation, atol=1e-6, rtol=0)
    assert peaks_follow(data.spectra(GRID)) < 3


def test_espargos_has_one_array_of_several(tmp_path):
    folder = write_espargos(tmp_path / "lab", arrays=2)
    with pytest.raises(InputError, match=r"2 arrays.*station \(1 A, 2 A\)"):
        load_snapshots(folder)
    assert peaks_follow(load_spectra(folder, station=1, grid=GRID)) < 3
    assert peaks_follow(load_spectra(folder, station=2, grid=GRID)) > 3
    with pytest.raises(InputError, match="station"):
        load_snapshots(folder, station=3)


def test_every_and_files(tmp_path):
    folder = write_espargos(tmp_path / "lab")
    (folder / "again.tfrecords").write_bytes((folder / "walk.tfrecords").read_bytes())
    assert load_snapshots(folder, every=10).index.tolist() == [0, 10, 20, 30, 40]
    assert len(load_snapshots(folder / "walk.tfrecords")) == 24


def test_records_without_position_are_left_out_and_counted(tmp_path):
    folder = write_espargos(tmp_path / "lab")
    csi = np.ones((1, 2, 4, 3), dtype=np.complex64)
    examples = [{"csi": csi, "pos": np.array([1.0, i, 1.0])} for i in (0.0, np.nan, 2.0)]
    write_records(folder / "walk.tfrecords", examples)
    data = load_snapshots(folder)
    assert data.index.tolist() == [0, 2]
    assert "left out: 1" in data.notes[0]


@pytest.mark.parametrize("offsets", [False, True])
def test_dichasus(tmp_path, offsets):
    folder = write_dichasus(tmp_path / "hall", offsets)
    data = load_snapshots(folder, station=1)
    assert data.channel.shape == (24, 8, 4)
    assert peaks_follow(data.spectra(GRID)) < 8  # an array of two elements a side
    assert any("calibrate" in note for note in data.notes) != offsets
    assert ("reftx-offsets-walk.json" in data.source) == offsets


def test_dichasus_by_direction_hangs_upright(tmp_path):
    antenna = {"name": "A", "location": [0, 0, 1], "direction": [1, 0, 0], "spacingX": 0.06, "spacingY": 0.06}
    folder = write_dichasus(tmp_path / "hall", antennas=[antenna | {"assignments": [[6, 0], [3, None]]}])
    data = load_snapshots(folder)
    right_is_y = torch.tensor([[0, 1, 0], [0, 0, 1], [1, 0, 0]]).double()  # seen from the front
    torch.testing.assert_close(data.rotation.T, right_is_y, rtol=0, atol=1e-12)
    assert data.array.element.tolist() == pytest.approx(np.array([[-0.03, 0.03], [0.03, 0.03], [-0.03, -0.03]]))
