"""Readers of the NeRF2 layout and of ray paths: what they read, and everything they refuse, hostile files included."""

import io
import math
import resource
import zipfile
import zlib

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


def _write(name, text):
    return lambda folder: (folder / name).write_bytes(text.encode() if isinstance(text, str) else text)


def _image(name, array, kind="PNG"):
    return lambda folder: Image.fromarray(array).save(folder / "spectrum" / name, format=kind)


def _png(rows, columns, kind=b"IHDR"):
    """A PNG of zeros, written without its pixels ever being in memory."""

    def chunk(name, data):
        return len(data).to_bytes(4, "big") + name + data + zlib.crc32(name + data).to_bytes(4, "big")

    size = columns.to_bytes(4, "big") + rows.to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])
    return b"\x89PNG\r\n\x1a\n" + chunk(kind, size) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def _positions(row):
    return _write("tx_pos.csv", "x,y,z\n" + "".join(f"{i},1,1\n" for i in range(1, N)) + row + "\n")


def _gateway(content):
    return _write("gateway_info.yml", f"g: {{{content}}}\n")


WRONG = {
    "no pose": (lambda f: (f / "gateway_info.yml").unlink(), "gateway_info.yml is missing"),
    "pose is no yaml": (_write("gateway_info.yml", "a: [1"), "not valid YAML"),
    "pose runs code": (
        _write("gateway_info.yml", "a: !!python/object/apply:os.getcwd []"),
        "must describe one gateway",
    ),
    "quaternion": (_gateway("position: [0, 0, 0], orientation: [0, 0, 1, 1]"), "unit quaternion"),
    "no gateway": (_write("gateway_info.yml", "name: x\n"), "one gateway"),
    "short position": (
        _gateway("position: [0, 0], orientation: [0, 0, 0, 1]"),
        r"position must have shape \(3\)",
    ),
    "no positions": (lambda f: (f / "tx_pos.csv").unlink(), "one of tx_pos.csv"),
    "both ends move": (_write("rx_pos.csv", "x,y,z\n1,1,1\n"), "one of tx_pos.csv"),
    "header": (_write("tx_pos.csv", "a,b,c\n1,2,3\n"), "header x,y,z"),
    "empty table": (_write("tx_pos.csv", ""), "is empty"),
    "no rows": (_write("tx_pos.csv", "x,y,z\n"), "no rows"),
    "nan": (_positions("nan,1,1"), "row 11, counted from 0"),
    "infinite": (_positions("inf,1,1"), "row 11, counted from 0"),
    "text": (_positions("here,1,1"), "row 12, column x: 'here' is not a number"),
    "short row": (_positions("1,1"), "row 12 has 2 values"),
    "at the gateway": (_positions("0,0,0"), "position 11 of .* is that of the fixed end"),
    "more positions than images": (_write("tx_pos.csv", "x,y,z\n" + "1,1,1\n" * 13), "12 images, but there are 13"),
    "no images": (lambda f: [p.unlink() for p in (f / "spectrum").iterdir()], "0 images"),
    "a gap in the numbers": (
        lambda f: (f / "spectrum/00003.png").rename(f / "spectrum/00099.png"),
        "00003.png is missing",
    ),
    "shape": (_image("00003.png", np.zeros((10, 30), np.uint8)), "10 x 30 pixels"),
    "another shape": (_image("00003.png", np.zeros((20, 80), np.uint8)), "must have one shape"),
    "colour": (_image("00003.png", np.zeros((10, 40, 3), np.uint8)), "mode RGB"),
    "empty image": (lambda f: (f / "spectrum/00003.png").write_bytes(b""), "not a complete PNG"),
    "truncated image": (
        lambda f: (f / "spectrum/00003.png").write_bytes((f / "spectrum/00003.png").read_bytes()[:60]),
        "not a complete PNG",
    ),
    **{
        f"{kind} called PNG": (_image("00001.png", np.zeros((10, 40), np.uint8), kind), "not a complete PNG")
        for kind in ("EPS", "BMP", "TIFF", "GIF")
    },
    "images that are not decoded": (
        lambda f: [image.write_bytes(_png(5000, 20000)) for image in (f / "spectrum").iterdir()],
        "pixels; take one measurement of several",
    ),
    "index out of range": (_write("test_index.txt", "00013\n"), "expected 1 to 12"),
    "index below range": (_write("test_index.txt", "0\n"), "expected 1 to 12"),
    "index twice": (_write("test_index.txt", "11\n11\n"), "twice"),
    "index is text": (_write("test_index.txt", "eleven\n"), "whole number"),
    "overlap": (_write("test_index.txt", "10\n"), "both its training and its test"),
    "one part only": (lambda f: (f / "test_index.txt").unlink(), "test_index.txt is missing"),
}


@pytest.mark.parametrize("name", WRONG)
def test_refuses(nerf2, name):
    spoil, says = WRONG[name]
    spoil(nerf2)
    with pytest.raises(InputError, match=says):
        load_spectra(nerf2)


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


def test_refuses_a_broken_archive(tmp_path):
    write_paths(tmp_path / "paths")
    file = tmp_path / "paths" / "paths.npz"
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(InputError, match="not an npz archive"):
        load_spectra(tmp_path / "paths")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"last_point": np.stack([np.arange(1.0, N + 1), np.zeros(N), np.ones(N)], axis=1)}, "no direction"),
        ({"frequency_hz": np.float64(1e-320)}, "carrier"),
        ({"receiver_position": np.tile([0.0, 0.0, 2.0], (N, 1))}, "at one place"),
        ({"gain": np.zeros(N, dtype=np.complex64)}, "gain other than 0"),
        ({"gain": np.full(N, 1e300 + 0j)}, "amplitudes"),
        ({"transmitter_position": np.full((N, 3), 1e300)}, "at most 1e"),
        ({"path_count": np.float64(1)}, "path_count"),
        ({"path_count": np.full(N, np.nan)}, "path_count"),
        ({"path_count": np.int32(3)}, "path_count"),
        ({"path_count": np.full(N, 2**62)}, "must have shape"),
        ({"gain": np.array(["a"] * N)}, "plain numbers"),
        ({"transmitter_position": np.ones((N, 3), dtype=complex)}, "complex"),
        ({"gain": None}, "lacks gain"),
        ({"gain": np.ones(5, np.complex64)}, "gain must have shape"),
        ({"gain": np.full(N, np.nan, np.complex64)}, "gain must be finite"),
        ({"path_count": np.arange(N, dtype=np.int32)}, "at least one path"),
        ({"frequency_hz": np.float64(-1)}, "frequency_hz"),
        ({"last_point": np.array([object()] * N)}, "plain numbers"),
    ],
)
def test_paths_without_usable_numbers_are_refused(tmp_path, changes, says):
    with pytest.raises(InputError, match=says):
        load_spectra(write_paths(tmp_path / "p", **changes))


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


def _rssi(value):
    return _write("gateway_rssi.csv", "a,b,c\n" + f"{value},-60,-70\n" + "-50,-60,-70\n" * (ROWS - 1))


def _train_index(content):
    return lambda f: [_write(name, text)(f) for name, text in (("train_index.txt", content), ("test_index.txt", "1\n"))]


WRONG_RSSI = {
    "positions in Latin-1": (_write("tx_pos.csv", "x,y,z\n\xe4,1,1\n".encode("latin-1")), "UTF-8"),
    "positions in UTF-16": (_write("tx_pos.csv", "x,y,z\n1,1,1\n".encode("utf-16")), "UTF-8"),
    "receivers in Latin-1": (_write("gateway_position.yml", "\xe4: [1, 2, 3]".encode("latin-1")), "UTF-8"),
    "index in UTF-16": (_train_index("1\n".encode("utf-16")), "UTF-8"),
    "index with an underscore": (_train_index(b"1_0\n"), "whole number"),
    "index of 5,000 digits": (_train_index(b"9" * 5000), "whole number"),
    "number with an underscore": (_write("tx_pos.csv", b"x,y,z\n1_0,1,1\n"), "not a number"),
    "far position": (_write("tx_pos.csv", b"x,y,z\n1e10,1,1\n"), "must match"),
    "a cell without end": (_write("tx_pos.csv", b'x,y,z\n"' + b"1" * 200_000 + b'",1,1\n'), "comma-separated"),
    "no name": (_write("gateway_rssi.csv", b"a,\n" + b"-50,-60\n" * ROWS), "no name for column 2"),
    "text as place": (_write("gateway_position.yml", b"a: '123'\nb: [5, 0, 1]\n"), "'a' needs a position"),
    "date as place": (_write("gateway_position.yml", b"a: 2001-99-99\nb: [5, 0, 1]\n"), "'a' needs a position"),
    "place of 5,000 digits": (
        _write("gateway_position.yml", b"a: [0, 0, " + b"9" * 5000 + b"]\nb: [5, 0, 1]\n"),
        "'a' needs a position",
    ),
    "deep YAML": (_write("gateway_position.yml", b"a: " + b"[" * 5000 + b"]" * 5000), "not valid YAML"),
    "YAML in itself": (_write("gateway_position.yml", b"a: &a [*a]\nb: [1, 2, 3]"), "not valid YAML"),
    "lists as names": (_write("gateway_position.yml", b"? [1, 2]\n: 3"), "is not valid YAML"),
    "too strong": (_rssi(31), "row 1, receiver a: 31 dBm"),
    "too weak": (_rssi(-151), "row 1, receiver a: -151 dBm"),
    "text": (_rssi("loud"), "row 1, column a: 'loud' is not a number"),
    "short row": (_rssi("-50,-60"), "row 1 has 4 values"),
    "two of one name": (_write("gateway_rssi.csv", "a,a,c\n-1,-2,-3\n"), "'a' twice"),
    "another number of rows": (_write("gateway_rssi.csv", "a,b,c\n-50,-60,-70\n"), "has 1 rows, tx_pos.csv 15"),
    "empty": (_write("gateway_rssi.csv", ""), "is empty"),
    "no receiver with a place": (_write("gateway_position.yml", "d: [0, 0, 1]\n"), "has none of the receivers"),
    "two places of one name": (_write("gateway_position.yml", "a: [0, 0, 1]\na: [1, 1, 1]\n"), "'a' twice"),
    "place of two numbers": (_write("gateway_position.yml", "a: [0, 0]\nb: [1, 1]\nc: [1, 2]\n"), "3 finite numbers"),
    "nan positions": (_write("tx_pos.csv", "x,y,z\n" + "nan,1,1\n" * ROWS), "needs 3 finite numbers"),
    "origin": (_write("survey.yml", "origin: [91, 0]"), "latitude and longitude"),
    "floors": (_write("survey.yml", "floors: {up: 4, down: 1}"), "ascending"),
    "one number of floors": (_write("survey.yml", "floors: 3"), "names with ascending heights"),
    "moving receiver": (_write("survey.yml", "receiver_moves: perhaps"), "true or false"),
    "unknown property": (_write("survey.yml", "storeys: 3"), "states storeys"),
    "index out of range": (
        lambda f: [_write(f"{part}_index.txt", text)(f) for part, text in (("train", "0\n"), ("test", "15\n"))],
        "expected 0 to 14",
    ),
}


@pytest.mark.parametrize("name", WRONG_RSSI)
def test_refuses_rssi(folder, name):
    spoil, says = WRONG_RSSI[name]
    spoil(folder)
    with pytest.raises(InputError, match=says) as refused:
        load_rssi(folder)
    assert len(str(refused.value)) <= 300


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
