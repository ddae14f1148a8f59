"""Saved models are opened as they were written, or refused."""

import json

import pytest
import torch
from safetensors.torch import load, save

from swiftwrf import InputError
from swiftwrf.runtime import checkpoint

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


def test_a_file_without_a_digest_is_refused(file):
    metadata = {"kind": "kind", "format": str(checkpoint.FORMAT), "header": json.dumps(HEADER)}
    file.write_bytes(save(TENSORS, metadata))
    with pytest.raises(InputError, match="is damaged"):
        checkpoint.read(file, "kind")
