"""Saved models are opened as they were written, or refused."""

import json
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import pytest
import torch
from annotated_types import Gt
from safetensors.torch import load, save
from torch import Tensor

from swiftwrf import InputError
from swiftwrf.runtime import checkpoint
from swiftwrf.runtime.checkpoint import pack, unpack

TENSORS = {
    "float": torch.tensor([[1.5, -2.0, 0.0], [4.0, 1e-30, 3e38]]),
    "double": torch.rand(5, dtype=torch.float64, generator=torch.Generator().manual_seed(0)),
    "half": torch.ones(3, dtype=torch.bfloat16),
    "complex": torch.ones(2, dtype=torch.complex64),
    "mask": torch.tensor([True, False]),
    "number": torch.tensor(7),
    "empty": torch.empty(0, 3),
}
HEADER = {"options": {"seed": 1}, "name": "caf\u00e9"}


@pytest.fixture
def file(tmp_path):
    checkpoint.write(tmp_path / "model", "kind", TENSORS, HEADER)
    return tmp_path / "model"


def is_as_written(file):
    _, tensors, header = checkpoint.read(file, "kind")
    assert tensors.keys() == TENSORS.keys()
    return header == HEADER and all(torch.equal(tensors[name], TENSORS[name]) for name in TENSORS)


def test_a_file_with_any_changed_byte_is_refused_or_says_what_was_written(file):
    assert is_as_written(file)
    content, refused = file.read_bytes(), 0
    for at in range(8, len(content)):
        file.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        try:
            assert is_as_written(file), at
        except InputError:
            refused += 1
    assert refused > len(content) - 20  # the others are blanks, and the name of the digest


def test_other_numbers_are_refused_although_they_are_finite(file):
    with file.open("rb") as stream:
        size = int.from_bytes(stream.read(8), "little")
        metadata = json.loads(stream.read(size))["__metadata__"]
    tensors = load(file.read_bytes())
    file.write_bytes(save(tensors | {"double": tensors["double"] * 2e300}, metadata))
    with pytest.raises(InputError, match="is damaged: its content is not what was written; create the file again"):
        checkpoint.read(file, "kind")
    file.write_bytes(save(tensors, metadata | {"header": json.dumps(HEADER | {"options": {"seed": 2}})}))
    with pytest.raises(InputError, match="is damaged"):
        checkpoint.read(file, "kind")


def test_one_tensor_with_two_names_is_stored_twice(tmp_path):
    checkpoint.write(tmp_path / "model", "kind", {"a": TENSORS["double"], "b": TENSORS["double"][:3]}, {})
    _, tensors, _ = checkpoint.read(tmp_path / "model", "kind")
    assert torch.equal(tensors["a"], TENSORS["double"])
    assert torch.equal(tensors["b"], TENSORS["double"][:3])


def test_a_file_without_a_digest_is_refused(file):
    metadata = {"kind": "kind", "format": str(checkpoint.FORMAT), "header": json.dumps(HEADER)}
    file.write_bytes(save(TENSORS, metadata))
    with pytest.raises(InputError, match="is damaged"):
        checkpoint.read(file, "kind")


class Origin(NamedTuple):
    latitude: float
    longitude: float


@dataclass
class Rows:
    position: Annotated[Tensor, "float64 n 3"]
    value: Annotated[Tensor, "float n r nan"]


@dataclass
class Choice:
    names: Annotated[tuple[str, ...], "r"]
    rows: Annotated[Rows, "r"]
    parts: list[Rows]
    component: Annotated[Tensor, "float32 1+rows.n k", Gt(0)]
    k: int
    mode: Literal["one", "two"]
    origin: Origin | None
    mask: Annotated[Tensor, "bool k"] | None
    other: Rows | Origin


def tree(**changes):
    generator = torch.Generator().manual_seed(0)

    def rows(n):
        return Rows(torch.rand(n, 3, generator=generator, dtype=torch.float64), torch.rand(n, 2, generator=generator))

    known = {"names": ("a", "b"), "rows": rows(4), "parts": [rows(1), rows(2)], "k": 7, "mode": "two", "mask": None}
    known |= {"component": torch.rand(5, 7) + 1, "origin": Origin(48.0, 11.0), "other": rows(3)}
    return Choice(**known | changes)


@pytest.mark.parametrize("changes", [{}, {"mask": torch.ones(7).bool(), "origin": None}, {"other": Origin(0.0, 1.0)}])
def test_a_tree_is_unpacked_as_it_was_packed(changes, tmp_path):
    before = tree(**changes)
    before.rows.value[1, 0] = torch.nan
    tensors, header = pack(before)
    checkpoint.write(tmp_path / "tree", "tree", tensors, header)
    after = unpack(Choice, *checkpoint.read(tmp_path / "tree", "tree")[1:])
    torch.testing.assert_close(after.rows.value, before.rows.value, rtol=0, atol=0, equal_nan=True)
    again = pack(after)
    assert again[1] == header
    assert all(torch.equal(again[0][name], tensor) for name, tensor in tensors.items())
    assert (after.names, after.k, after.origin, after.mask is None) == (
        before.names,
        7,
        before.origin,
        before.mask is None,
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"names": ("a", "b", "c")}, r"rows.value has shape \(4, 2\), but the configuration calls for \(4, 3\)"),
        ({"component": torch.ones(4, 7)}, r"component has shape \(4, 7\), .* \(5, 7\)"),
        ({"component": torch.ones(5)}, r"component has shape \(5,\), .* \(5, k\)"),
        ({"component": torch.ones(5, 7).double()}, "component has numbers of type float64, expected float32"),
        ({"component": torch.zeros(5, 7)}, "component must be above 0"),
        ({"component": torch.ones(5, 7) * torch.nan}, "component holds a value that is not finite"),
        ({"mask": torch.ones(6).bool(), "k": 7}, r"mask has shape \(6,\)"),
        ({"k": 7.5}, "k must be a whole number, got 7.5"),
        ({"mode": "three"}, "mode must be 'one' or 'two', got 'three'"),
        ({"origin": Origin(1.0, "x")}, "origin.longitude must be a number, got 'x'"),
        ({"rows": None}, "rows must be a dictionary, got None"),
        ({"parts": [Origin(0.0, 0.0)]}, r"parts\.0\.\w+ is (unknown|missing)"),
    ],
)
def test_values_that_an_annotation_does_not_allow_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        unpack(Choice, *pack(tree(**changes)))


def test_missing_and_unknown_names_are_refused():
    tensors, header = pack(tree(mask=torch.ones(7).bool()))
    with pytest.raises(InputError, match="mask is missing"):
        unpack(Choice, {name: tensor for name, tensor in tensors.items() if name != "mask"}, header)
    with pytest.raises(InputError, match="k is missing"):
        unpack(Choice, tensors, {name: value for name, value in header.items() if name != "k"})
    with pytest.raises(InputError, match="more is unknown"):
        unpack(Choice, tensors, header | {"more": 1})
