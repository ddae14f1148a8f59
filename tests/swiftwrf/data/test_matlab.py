"""MATLAB files are read as SciPy reads them, and damaged ones are refused: none ends the process or takes its memory."""

import random
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from swiftwrf import InputError
from swiftwrf.data.archives import array_names, read_arrays

TYPES = ["?", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8", "c8", "c16"]
SHAPES = [(), (3,), (2, 3), (2, 3, 4), (0, 3), (5, 1, 1, 7)]
OTHER = {"text": "abc", "cell": np.array([1, "x"], dtype=object), "structure": {"x": 1}}


def arrays(dtype):
    """Return arrays of all shapes."""
    draw = np.random.default_rng(0)
    values = {f"a{i}": draw.random(shape) * 100 for i, shape in enumerate(SHAPES)}
    turned = {name: value + (1j * value if dtype.startswith("c") else 0) for name, value in values.items()}
    return {name: np.asarray(value).astype(dtype) for name, value in turned.items()}


@pytest.mark.parametrize("options", [{}, {"do_compression": True}, {"format": "4"}], ids=str)
@pytest.mark.parametrize("dtype", TYPES)
def test_arrays_are_those_that_scipy_reads(tmp_path, dtype, options):
    known, file = arrays(dtype), tmp_path / "a.mat"
    if "format" in options:
        if dtype in ("?", "i1", "i8", "u4", "u8", "c8"):
            pytest.skip("version 4 has no such type")
        known = {name: value for name, value in known.items() if value.ndim <= 2}
    savemat(file, known | (OTHER if "format" not in options else {"text": "abc"}), **options)
    assert array_names(file) >= set(known)
    found, expected = read_arrays(file, list(known)), loadmat(file)
    for name, values in found.items():
        np.testing.assert_array_equal(values, expected[name])
        assert values.dtype.kind == expected[name].dtype.kind
        assert values.dtype.isnative
        assert values.flags.c_contiguous


@pytest.mark.parametrize("name", OTHER)
def test_what_is_no_array_of_numbers_is_refused(tmp_path, name):
    savemat(tmp_path / "a.mat", OTHER)
    with pytest.raises(InputError, match=r"a\.mat is not a MATLAB file of plain numbers .*expected numbers"):
        read_arrays(tmp_path / "a.mat", [name])


def element(order, kind, content):
    return struct.pack(f"{order}II", kind, len(content)) + content + b"\0" * (-len(content) % 8)


def variable(order, values, shape=None, kind=9):
    """Return the bytes of the variable `csi` of doubles, written by hand."""
    flags, shape = struct.pack(f"{order}II", 6, 0), struct.pack(f"{order}2i", *(shape or values.shape))
    body = element(order, 6, flags) + element(order, 5, shape) + element(order, 1, b"csi")
    return element(order, 14, body + element(order, kind, values.astype(f"{order}f8").tobytes(order="F")))


def header(order):
    return b"MATLAB 5.0".ljust(124) + struct.pack(f"{order}H", 0x0100) + struct.pack(f"{order}H", 0x4D49)


@pytest.mark.parametrize("order", ["<", ">"])
def test_both_orders_of_bytes_are_read(tmp_path, order):
    values = np.arange(6.0).reshape(2, 3)
    (tmp_path / "a.mat").write_bytes(header(order) + variable(order, values))
    np.testing.assert_array_equal(read_arrays(tmp_path / "a.mat", ["csi"])["csi"], values)


def test_an_infinite_imaginary_part_leaves_the_real_part(tmp_path):
    savemat(tmp_path / "a.mat", {"csi": np.array([[complex(1, np.inf)]])})
    assert read_arrays(tmp_path / "a.mat", ["csi"])["csi"].real.item() == 1


ONE = np.ones((1, 1))
BOMB = zlib.compress(variable("<", ONE) + b"\0" * 2**30)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (variable("<", ONE)[:-8], "not complete"),
        (variable("<", ONE) * 2, "csi is stored twice"),
        (variable("<", ONE, (2**16, 2**15)), "it unpacks to 34359738368 bytes"),
        (variable("<", ONE, (2, 2**15)), "does not hold the"),
        (variable("<", ONE, (-1, -1)), "is not a MATLAB file"),
        (variable("<", ONE, kind=91), "unknown type 91"),
        (struct.pack("<II", 15, len(BOMB)) + BOMB, "is not a MATLAB file"),
        (struct.pack("<II", 14, 2**32 - 1), "not complete"),
    ],
    ids=["cut", "twice", "claim", "small claim", "negative", "unknown", "bomb", "length"],
)
def test_what_a_file_claims_is_compared_with_what_it_holds(tmp_path, content, words):
    (tmp_path / "a.mat").write_bytes(header("<") + content)
    tracemalloc.start()
    with pytest.raises(InputError, match=words):
        read_arrays(tmp_path / "a.mat", ["csi"])
    assert tracemalloc.get_traced_memory()[1] < 2**24
    tracemalloc.stop()


@pytest.mark.filterwarnings("ignore:We do not support byte ordering")
@pytest.mark.parametrize("options", [{}, {"do_compression": True}, {"format": "4"}], ids=str)
def test_any_changed_byte_is_read_or_refused(tmp_path, options):
    """The parser of SciPy ended the process at 5 of 300 changes of an uncompressed file, e.g. byte 1520."""
    file, draw = tmp_path / "snapshots.mat", random.Random(0)
    savemat(file, {"csi": np.ones((4, 8)) * (1 + 1j), "position": np.ones((4, 3)), "rows": np.ones((1, 1))}, **options)
    content, ends = file.read_bytes(), {"read": 0, "refused": 0}
    for at in range(0, len(content), 2):
        changed = bytearray(content)
        changed[at] = draw.choice([0, 9, 91, 255, content[at] ^ 1])
        file.write_bytes(changed)
        try:
            read_arrays(file, ["csi"], sorted(array_names(file) & {"position", "rows"}))
            ends["read"] += 1
        except InputError:
            ends["refused"] += 1
    assert min(ends.values()) > 10
