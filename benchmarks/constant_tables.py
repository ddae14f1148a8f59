"""The table of the numeric module constants of the core, from its source, with the reason beside each."""

from __future__ import annotations

import ast
import tokenize
from collections.abc import Iterator
from pathlib import Path

from record import ROOT, markdown

CONTRIB = "contrib"


def constants() -> str:
    """Return name, value, module and reason of the numeric constants of `swiftwrf` without `contrib`."""
    rows = []
    for file in sorted((ROOT / "swiftwrf").rglob("*.py")):
        module = ".".join(file.relative_to(ROOT).with_suffix("").parts)
        if CONTRIB not in file.parts:
            rows += [[f"`{name}`", f"`{value}`", f"`{module}`", reason] for name, value, reason in _numbers(file)]
    return markdown(["constant", "value", "module", "what it is, and why"], rows)


def _numbers(file: Path) -> Iterator[tuple[str, str, str]]:
    """Yield name, expression and comment of the constants of a module whose values are numbers, or tuples of numbers."""
    with file.open("rb") as source:
        comments = {
            t.start[0]: t.string.lstrip("# ") for t in tokenize.tokenize(source.readline) if t.type == tokenize.COMMENT
        }
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if not isinstance(node, ast.Assign) or not _is_number(node.value):
            continue
        reason = comments.get(node.end_lineno or 0) or comments.get(node.lineno - 1, "")
        targets = [
            each for target in node.targets for each in (target.elts if isinstance(target, ast.Tuple) else [target])
        ]
        values = (
            node.value.elts if len(targets) > 1 and isinstance(node.value, ast.Tuple) else [node.value] * len(targets)
        )
        for target, value in zip(targets, values, strict=True):
            if isinstance(target, ast.Name) and target.id.isupper():
                yield target.id, ast.unparse(value), reason.replace("|", "\\|")


def _is_number(value: ast.expr) -> bool:
    """Return True for a number, an expression of numbers, or a tuple of these."""
    if isinstance(value, ast.Tuple):
        return bool(value.elts) and all(map(_is_number, value.elts))
    if isinstance(value, ast.BinOp):
        return _is_number(value.left) and _is_number(value.right)
    if isinstance(value, ast.UnaryOp):
        return _is_number(value.operand)
    return (
        isinstance(value, ast.Constant) and isinstance(value.value, int | float) and not isinstance(value.value, bool)
    )
