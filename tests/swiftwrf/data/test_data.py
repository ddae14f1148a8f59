"""Readers of the NeRF2 layout and of ray paths: what they read, and everything they refuse, hostile files included."""

import io
import math
import resource
import zipfile

import numpy as np
import pytest
import torch
from PIL import Image
from samples import write_nerf2, write_nerf2_rssi, write_paths

from swiftwrf import InputError, load_rssi, load_spectra, rssi_room
from swiftwrf.data.spectra import coarsening

N = 12


@pytest.fixture
def nerf2(tmp_path):
    """A well-formed folder in the NeRF2 layout."""
    images = [np.full((10, 40), i, dtype=np.uint8) for i in range(1, N + 1)]
    folder = write_nerf2(tmp_path / "scene", images, "[0, 0, 0.70710678, 0.70710678]\ndataset_name: scene")
    (folder / "train_index.txt").write_text("\n".join(f"{i:05d}" for i in range(1, 11)))
    (folder / "test_index.txt").write_text("00011\n00012\n")
    return folder


def test_reads_the_nerf2_layout(nerf2):
    data = load_spectra(nerf2)
    assert (len(data), data.name, data.moving, data.grid.shape) == (N, "scene", "transmitter", (10, 40))
    assert data.spectrum[4, 0, 0].item() == pytest.approx(5 / 255)
    # the array's x axis points to world y; the transmitter is due north of the first position
    assert data.label[0, 0].item() == pytest.approx(0, abs=1e-6)
    assert data.label[0, 1].item() == pytest.approx(math.atan2(1.5, 10), abs=1e-6)
    train, test = data.split("random")
    assert train.index.tolist() == list(range(10))
    assert test.index.tolist() == [10, 11]


def test_every_file_counts_as_input(nerf2):
    before = load_spectra(nerf2).source
    Image.fromarray(np.full((10, 40), 99, np.uint8)).save(nerf2 / "spectrum" / "00007.png")
    after = load_spectra(nerf2).source
    assert {name for name in before if before[name] != after[name]} == {"spectrum/*.png"}


def test_refuses_few_training_spectra_and_unknown_splits(nerf2):
    (nerf2 / "train_index_few.txt").write_text("1\n2\n")
    (nerf2 / "test_index_few.txt").write_text("3\n")
    data = load_spectra(nerf2)
    with pytest.raises(InputError, match="has 2 training"):
        data.split("few")
    with pytest.raises(InputError, match="choose one of block, few, random"):
        data.split("radnom")


def test_spectrum_of_one_path_peaks_where_it_comes_from(tmp_path):
    data = load_spectra(write_paths(tmp_path / "paths"))
    assert data.moving == "receiver"
    row, column = divmod(int(data.spectrum[0].argmax()), 360)
    assert (column, row + 1) == (180, 45)  # from -x, as far up as away
    assert data.spectrum[0].max().item() == pytest.approx(1, abs=1e-4)
    assert data.label[0].rad2deg().tolist() == pytest.approx([180, 45], abs=1e-4)


def test_the_end_with_more_positions_moves(tmp_path):
    still = np.tile([3.0, 0.0, 1.0], (N, 1))
    moves = np.stack([np.arange(1.0 * N), np.ones(N), np.ones(N)], axis=1)
    data = load_spectra(write_paths(tmp_path / "p", receiver_position=still, transmitter_position=moves))
    assert data.moving == "transmitter"


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32, np.uint64, ">i4", np.longdouble])
def test_paths_in_other_precisions(tmp_path, dtype):
    usual = load_spectra(write_paths(tmp_path / "a"))
    single = np.tile([0.0, 0.0, 2.0], (N, 1)).astype(np.float32)
    same = {"path_count": np.ones(N, dtype=dtype), "transmitter_position": single, "last_point": single}
    other = load_spectra(write_paths(tmp_path / "b", **same))
    torch.testing.assert_close(other.spectrum, usual.spectrum)
    torch.testing.assert_close(other.label, usual.label)


def _bomb(header):
    """A small npz whose first array claims or unpacks to much."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("receiver_position", "path_count", "last_point", "gain", "line_of_sight", "frequency_hz"):
            archive.writestr(f"{name}.npy", b"")
        archive.writestr("transmitter_position.npy", header)
    return content.getvalue()


def test_small_archives_that_claim_much_are_refused_before_memory_is_taken(tmp_path, monkeypatch):
    monkeypatch.setattr("swiftwrf.data.archives.MAX_UNPACKED_BYTES", 2**26)
    (tmp_path / "paths.npz").write_bytes(_bomb(bytes(2**26 + 1)))
    assert (tmp_path / "paths.npz").stat().st_size < 2**18
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="unpacks to"):
        load_spectra(tmp_path)
    claim = io.BytesIO()
    np.lib.format.write_array_header_1_0(claim, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)})
    (tmp_path / "paths.npz").write_bytes(_bomb(claim.getvalue()))
    with pytest.raises(InputError, match="claims"):
        load_spectra(tmp_path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**20  # KiB


def test_coarsen_averages(nerf2):
    data = load_spectra(nerf2)
    coarse = data.coarsen(2)
    assert coarse.spectrum.shape == (N, 5, 20)
    torch.testing.assert_close(coarse.spectrum.mean(), data.spectrum.mean())
    with pytest.raises(InputError, match="cannot be averaged"):
        data.coarsen(3)


@pytest.mark.parametrize(
    ("shape", "most", "rows", "factor"),
    [
        ((90, 360), 0, 1, 1),
        ((90, 360), 180, 7, 2),
        ((90, 360), 100, 7, 5),
        ((45, 180), 120, 1, 3),
        ((15, 60), 30, 7, 1),
    ],
)
def test_coarsening_divides_both_sizes(shape, most, rows, factor):
    assert coarsening(shape, most, rows) == factor


@pytest.mark.data
def test_measured_spectra_have_the_published_labels(measured_data):
    data = load_spectra(measured_data / "s23-200")
    assert data.label[0].rad2deg().tolist() == pytest.approx([61.08, 77.75], abs=0.01)
    assert {name: (len(a), len(b)) for name, (a, b) in data.named_splits.items()} == {
        "random": (160, 40),
        "block": (160, 40),
    }


# RSSI


ROWS = 15


@pytest.fixture
def folder(tmp_path):
    """A well-formed folder: three receivers, the third detected only in the last five rows."""
    rows = [f"{-50 - i},{-60 - i},{-70 if i >= ROWS - 5 else -100}" for i in range(ROWS)]
    return write_nerf2_rssi(tmp_path, "a,b,c", "a: [0, 0, 1]\nb: [5, 0, 1]\nc: [0, 5, 1]\n", rows)


def test_reads_and_marks_what_was_not_detected(folder):
    data = load_rssi(folder)
    assert data.receiver_names == ("a", "b", "c")
    assert data.rssi_dbm[0, :2].tolist() == [-50, -60]
    assert data.rssi_dbm.isnan().sum(dim=0).tolist() == [0, 0, 10]
    assert data.receiver_position[1].tolist() == [5, 0, 1]


def test_receivers_by_number_name_and_all(folder):
    data = load_rssi(folder)
    assert data.receivers(["2"]).receiver_names == ("b",)
    assert data.receivers(["b", "1"]).receiver_names == ("b", "a")
    with pytest.raises(InputError, match="there are 1 a, 2 b, 3 c"):
        data.receivers(["4"])
    every = data.receivers(["all"])
    assert every.receiver_names == ("a", "b")
    assert every.notes[-1] == "receivers that detected fewer than 10 rows are left out: c"
    with pytest.raises(InputError, match=r"'c'.*5 rows"):
        data.receivers(["c"])
    with pytest.raises(InputError, match="detected the transmitter in 10 rows"):
        data.columns([2]).receivers(["all"])
    with pytest.raises(InputError, match="once"):
        data.receivers(["a", "1"])


def two_receivers(folder, names="a,b", position="a: [0, 0, 1]\nb: [5, 0, 1]\n"):
    return write_nerf2_rssi(folder, names, position, ["-50,-60"] * N)


def test_references_to_references_take_no_memory(tmp_path):
    lines = ["a0: &a0 [1, 2, 3]"] + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 40)]
    folder = two_receivers(tmp_path / "data", position="\n".join([*lines, "a: [0, 0, 1]", "b: *a0", ""]))
    assert load_rssi(folder).receiver_position[1].tolist() == [1, 2, 3]
    folder = two_receivers(tmp_path / "other", position="\n".join([*lines, "a: *a39", "b: *a0", ""]))
    with pytest.raises(InputError, match="receiver 'a' needs a position") as refused:
        load_rssi(folder)
    assert len(str(refused.value)) < 2000


def test_a_byte_order_mark_is_no_part_of_the_header(tmp_path):
    folder = two_receivers(tmp_path / "data")
    for file in folder.iterdir():
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert len(load_rssi(folder)) == N


@pytest.mark.parametrize("name", ["NA", "1", "12:34:56", "2001-01-01", "null", "true", "1e5", "~"])
def test_receivers_have_the_names_they_have(tmp_path, name):
    folder = two_receivers(tmp_path / "data", f"{name},b", f"{name}: [0, 0, 1]\nb: [5, 0, 1]\n")
    assert load_rssi(folder).receiver_names == (name, "b")


def test_room_is_seeded_and_looks_like_ble():
    a, b = rssi_room(n=80, seed=1), rssi_room(n=80, seed=1)
    assert torch.equal(a.rssi_dbm.nan_to_num(), b.rssi_dbm.nan_to_num())
    detected = ~a.rssi_dbm.isnan()
    assert 0.05 < 1 - detected.double().mean() < 0.4
    assert a.rssi_dbm[detected].min() > -105
    assert a.rssi_dbm[detected].max() < -20
    distance = torch.cdist(a.transmitter_position, a.receiver_position)[detected]
    near = distance < 4
    assert a.rssi_dbm[detected][near].median() > a.rssi_dbm[detected][distance > 12].median() + 8


@pytest.mark.data
def test_measured_rssi(measured_data):
    data = load_rssi(measured_data / "tetam-tracks")
    assert data.rssi_dbm.shape == (1534, 12)
    assert int((~data.rssi_dbm.isnan()).sum()) == 15731
    assert {name: (len(a), len(b)) for name, (a, b) in data.named_splits.items()} == {
        "random": (1227, 307),
        "spatial": (1217, 317),
        "block": (1120, 414),
    }
