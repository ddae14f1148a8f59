"""Blocks of documents, and the comparison of what they print with what the document shows."""

from __future__ import annotations

import re
from collections.abc import Iterator

FENCES = re.compile(r"```(python|bash)\n(.*?)```(?:\n+```text\n(.*?)```)?", flags=re.DOTALL)
NUMBER = re.compile(r"-?\d[\d,]*\.?\d*")
TOLERANCE = 0.1  # of a number, relative: other processors and library versions round differently


def blocks(text: str) -> Iterator[tuple[str, str, str]]:
    """Yield language, content and shown output of each block of Python and bash; a text block after it is its output."""
    yield from FENCES.findall(text)


def check_printed(shown: str, printed: str) -> None:
    """Compare the lines of a document with the lines of a program. `...` stands for any number of lines."""
    found = iter([" ".join(line.split()) for line in printed.splitlines()])
    for line in (" ".join(line.split()) for line in shown.splitlines() if line.strip() not in {"", "..."}):
        assert any(_alike(line, other) for other in found), f"not printed, or in another order: {line}\n{printed}"


def _alike(line: str, other: str) -> bool:
    if NUMBER.sub("#", line) != NUMBER.sub("#", other):
        return False
    pairs = zip(NUMBER.findall(line), NUMBER.findall(other), strict=True)
    numbers = [(float(a.replace(",", "")), float(b.replace(",", ""))) for a, b in pairs]
    return all(abs(a - b) <= TOLERANCE * max(abs(a), abs(b)) for a, b in numbers)
