"""Seeded mutations of files: bytes as a broken disk leaves them, and tokens as people and hostile tools write them.

`damages` replaces the arrays and values of a file in turn.
"""

import json
import random
import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from swiftwrf.runtime.checkpoint import read, write

TOKENS = [
    b"nan", b"inf", b"-1", b"0", b"1e400", b"1e-320", b"9" * 5000, b"2001-99-99", b"12:34:56", b"'123'", b"\xe4",
    b"\xff\xfe", b"\xef\xbb\xbf", b"\0", b"[" * 2000, b"&a [*a]", b"!!python/object/apply:os.getcwd []", b"=1+1", b"NA",
    b"", b",,", b"\r", b'"', b"1_0", "\u0661".encode(), b"{}", b"null", b"true", b"-0", b"1e20", b"4294967296",
    b"-9223372036854775809", b"\\", b"x" * 70_000, b"9" * 400,
    b"-99999", b"60", b"1e30",
]  # fmt: skip
EXTREME = [b"\0\0\0\0", b"\xff\xff\xff\xff", b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\xff" * 7 + b"\x7f", b"\0" * 8]
PLACES = re.compile(rb"[\w.+-]+")


def mutated(content: bytes, draw: random.Random, words_only: bool = False) -> bytes:
    """The content with one to four changes, or with other words only, which leave its syntax as it is more often."""
    for _ in range(draw.randint(1, 2 if words_only else 4)):
        content = draw.choice((_token,) if words_only else CHANGES)(content, draw)
    return content


def _flip(content: bytes, draw: random.Random) -> bytes:
    if not content:
        return content
    at = draw.randrange(len(content))
    return content[:at] + bytes([content[at] ^ (1 << draw.randrange(8))]) + content[at + 1 :]


def _cut(content: bytes, draw: random.Random) -> bytes:
    return content[: draw.randrange(len(content) + 1)]


def _insert(content: bytes, draw: random.Random) -> bytes:
    at = draw.randrange(len(content) + 1)
    return content[:at] + draw.choice([draw.choice(TOKENS), draw.randbytes(draw.randint(1, 8))]) + content[at:]


def _repeat(content: bytes, draw: random.Random) -> bytes:
    start, end = sorted(draw.randrange(len(content) + 1) for _ in range(2))
    return content[:end] + content[start:end][:10_000] + content[end:]


def _token(content: bytes, draw: random.Random) -> bytes:
    """Another token where a word or number stands."""
    places = list(PLACES.finditer(content[:100_000]))
    if not places:
        return content
    place = draw.choice(places)
    return content[: place.start()] + draw.choice(TOKENS) + content[place.end() :]


def _number(content: bytes, draw: random.Random) -> bytes:
    """Replace four or eight bytes, possibly a binary number, by an extreme value."""
    at = draw.randrange(len(content) + 1)
    extreme = draw.choice(EXTREME)
    return content[:at] + extreme + content[at + len(extreme) :]


CHANGES = (_flip, _cut, _insert, _repeat, _token, _token, _number)


def spoil(folder: Path, draw: random.Random) -> None:
    """Changes one file of a folder: its content, or whether and where it is."""
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    file = draw.choice(files)
    act = draw.random()
    if act < 0.04:
        file.unlink()
    elif act < 0.06:
        file.unlink()
        file.mkdir()
    elif act < 0.1:
        file.write_bytes(draw.choice(files).read_bytes())
    else:
        file.write_bytes(mutated(file.read_bytes(), draw))


OTHER_JSON = (None, "x", 1e400, [[]], {"a": None})


def damages(file: Path, kind: str) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield the name of each damage and the function that does it: arrays of other shapes, values of other kinds.

    Args:
        file: An archive of arrays, JSON or, without a suffix, a saved model.
        kind: Kind of the saved model.
    """
    yield "missing", file.unlink
    if file.suffix == ".npz":
        with np.load(file) as stored:
            arrays = dict(stored)
        for name, others in _damaged_arrays(arrays):
            yield name, partial(np.savez, file, **others)
    elif file.suffix == ".json":
        yield "brackets", partial(file.write_text, "[" * 100_000)
        for name, value in _damaged_values(json.loads(file.read_text())).items():
            yield name, partial(file.write_text, json.dumps(value))
    elif not file.suffix:
        _, tensors, header = read(file, kind)
        for name, tensor in tensors.items():
            others = {"deeper": tensor[None]}
            others |= {"flat": tensor.ravel()[None, :3]} if tensor.shape != (1, 1) else {}
            others |= {"shorter": tensor[:-1], "narrower": tensor[..., :-1]} if tensor.ndim else {}
            others |= {"nan": tensor * torch.nan} if tensor.is_floating_point() else {}
            for how, other in others.items():
                yield f"tensor {name} {how}", partial(write, file, kind, tensors | {name: other}, header)
            yield f"tensor {name} missing", partial(write, file, kind, _without(tensors, name), header)
        for name, value in _damaged_values(header).items():
            yield name, partial(write, file, kind, tensors, value)


def _without(content: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in content.items() if key != name}


def _damaged_arrays(arrays: dict[str, np.ndarray]) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """Yield arrays, one of which has another shape, type or range, or is missing."""
    yield "none", {}
    for name, array in arrays.items():
        others = {
            "flat": array.ravel()[:3],
            "deeper": array[None],
            "scalar": np.float64(1),
            "no rows": array[:0],
            "shorter": array[:-1],
            "complex": np.ones(array.shape, complex),
            "text": np.full(array.shape, "a"),
            "objects": np.full(array.shape, None),
            "nan": np.full(array.shape, np.nan),
            "huge": np.full(array.shape, 1e308),
            "infinite": np.full(array.shape, np.inf),
        }
        for how, other in others.items():
            yield f"{name} {how}", arrays | {name: other}
        yield f"{name} missing", _without(arrays, name)


def _damaged_values(content: object, others: tuple[object, ...] = OTHER_JSON) -> dict[str, object]:
    """Return JSON in which the whole or one value is of another kind, of fewer kinds at greater depth."""
    found = {repr(other): other for other in others}
    if isinstance(content, int):
        found |= {"-1": -1, "many": 10**12}
    if isinstance(content, dict):
        for number, (key, value) in enumerate(content.items()):
            few = _damaged_values(value, others[:-2])
            for kind in list(few)[number % 2 :: 2]:  # half of the values are enough
                found[f"{key} {kind}"] = content | {key: few[kind]}
            found[f"{key} missing"] = _without(content, key)
    if isinstance(content, list) and content:
        few = _damaged_values(content[0], others[:-2])
        found |= {f"[0] {kind}": [other, *content[1:]] for kind, other in few.items()}
    return found
