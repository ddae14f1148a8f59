"""Seeded mutations of files: bytes as a broken disk leaves them, and tokens as people and hostile tools write them."""

import random
import re
from pathlib import Path

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
