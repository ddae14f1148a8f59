"""Measurements that are damaged, foreign, or ask for more than they hold."""

import io
import resource
import zipfile
import zlib

import numpy as np
import pytest
import torch
from PIL import Image
from samples import write_nerf2, write_nerf2_rssi, write_paths

from swiftwrf import InputError, load_rssi, load_spectra

N = 12


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
def test_paths_that_say_nothing_are_refused(tmp_path, changes, says):
    with pytest.raises(InputError, match=says):
        load_spectra(write_paths(tmp_path / "p", **changes))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32, np.uint64, ">i4"])
def test_paths_in_other_precisions(tmp_path, dtype):
    usual = load_spectra(write_paths(tmp_path / "a"))
    single = np.tile([0.0, 0.0, 2.0], (N, 1)).astype(np.float32)
    other = load_spectra(
        write_paths(tmp_path / "b", path_count=np.ones(N, dtype=dtype), transmitter_position=single, last_point=single)
    )
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


def _png(rows, columns, kind=b"IHDR"):
    """A PNG of zeros, written without its pixels ever being in memory."""

    def chunk(name, data):
        return len(data).to_bytes(4, "big") + name + data + zlib.crc32(name + data).to_bytes(4, "big")

    size = columns.to_bytes(4, "big") + rows.to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])
    return b"\x89PNG\r\n\x1a\n" + chunk(kind, size) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


@pytest.fixture
def scene(tmp_path):
    """Twelve spectra in the NeRF2 layout."""
    return write_nerf2(tmp_path / "scene", [np.full((8, 32), i, np.uint8) for i in range(N)])


def test_every_file_counts_as_input(scene):
    before = load_spectra(scene).source
    Image.fromarray(np.full((8, 32), 99, np.uint8)).save(scene / "spectrum" / "00007.png")
    after = load_spectra(scene).source
    assert {name for name in before if before[name] != after[name]} == {"spectrum/*.png"}


def test_large_images_are_refused_before_they_are_decoded(scene):
    for i in range(N):
        (scene / "spectrum" / f"{i + 1:05d}.png").write_bytes(_png(5000, 20000))
    with pytest.raises(InputError, match="pixels; take one measurement of several"):
        load_spectra(scene)


@pytest.mark.parametrize("kind", ["EPS", "BMP", "TIFF", "GIF"])
def test_other_formats_called_png_are_not_opened(scene, kind):
    Image.fromarray(np.zeros((8, 32), np.uint8)).save(scene / "spectrum" / "00001.png", format=kind)
    with pytest.raises(InputError, match="not a complete PNG"):
        load_spectra(scene)


def _rssi(folder, names="a,b", position="a: [0, 0, 1]\nb: [5, 0, 1]\n"):
    return write_nerf2_rssi(folder, names, position, ["-50,-60"] * N)


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("tx_pos.csv", "x,y,z\n\xe4,1,1\n".encode("latin-1"), "UTF-8"),
        ("tx_pos.csv", "x,y,z\n1,1,1\n".encode("utf-16"), "UTF-8"),
        ("gateway_position.yml", "\xe4: [1, 2, 3]".encode("latin-1"), "UTF-8"),
        ("train_index.txt", "1\n".encode("utf-16"), "UTF-8"),
        ("train_index.txt", b"1_0\n", "whole number"),
        ("train_index.txt", b"9" * 5000, "whole number"),
        ("tx_pos.csv", b"x,y,z\n1_0,1,1\n", "not a number"),
        ("tx_pos.csv", b"x,y,z\n1e10,1,1\n", "must match"),
        ("tx_pos.csv", b'x,y,z\n"' + b"1" * 200_000 + b'",1,1\n', "comma-separated"),
        ("gateway_rssi.csv", b"a,\n" + b"-50,-60\n" * N, "no name for column 2"),
        ("gateway_position.yml", b"a: '123'\nb: [5, 0, 1]\n", "'a' needs a position"),
        ("gateway_position.yml", b"a: 2001-99-99\nb: [5, 0, 1]\n", "'a' needs a position"),
        ("gateway_position.yml", b"a: [0, 0, " + b"9" * 5000 + b"]\nb: [5, 0, 1]\n", "'a' needs a position"),
        ("gateway_position.yml", b"a: " + b"[" * 5000 + b"]" * 5000, "not valid YAML"),
        ("gateway_position.yml", b"a: &a [*a]\nb: [1, 2, 3]", "not valid YAML"),
        ("gateway_position.yml", b"? [1, 2]\n: 3", "is not valid YAML"),
    ],
)
def test_text_files_are_refused_in_a_sentence(tmp_path, file, content, says):
    folder = _rssi(tmp_path / "data")
    (folder / "test_index.txt").write_text("1\n")
    (folder / "train_index.txt").write_text("0\n")
    (folder / file).write_bytes(content)
    with pytest.raises(InputError, match=says) as refused:
        load_rssi(folder)
    assert len(str(refused.value)) <= 300


def test_references_to_references_take_no_memory(tmp_path):
    lines = ["a0: &a0 [1, 2, 3]"] + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 40)]
    folder = _rssi(tmp_path / "data", position="\n".join([*lines, "a: [0, 0, 1]", "b: *a0", ""]))
    assert load_rssi(folder).receiver_position[1].tolist() == [1, 2, 3]
    folder = _rssi(tmp_path / "other", position="\n".join([*lines, "a: *a39", "b: *a0", ""]))
    with pytest.raises(InputError, match="receiver 'a' needs a position") as refused:
        load_rssi(folder)
    assert len(str(refused.value)) < 2000


def test_a_byte_order_mark_is_no_part_of_the_header(tmp_path):
    folder = _rssi(tmp_path / "data")
    for file in folder.iterdir():
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert len(load_rssi(folder)) == N


@pytest.mark.parametrize("name", ["NA", "1", "12:34:56", "2001-01-01", "null", "true", "1e5", "~"])
def test_receivers_have_the_names_they_have(tmp_path, name):
    folder = _rssi(tmp_path / "data", f"{name},b", f"{name}: [0, 0, 1]\nb: [5, 0, 1]\n")
    assert load_rssi(folder).receiver_names == (name, "b")
