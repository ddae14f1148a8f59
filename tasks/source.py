"""The options of all commands that say how files are read, where they leave it open."""

from __future__ import annotations

from swiftwrf import InputError


def named_columns(columns: tuple[str, ...]) -> dict[str, str] | None:
    """`x=NAME` as a mapping; None where there are none.

    Raises:
        InputError: something else, or a role twice.
    """
    pairs = [text.partition("=") for text in columns]
    for text, (role, _, name) in zip(columns, pairs, strict=True):
        if not role or not name:
            raise InputError(f"--columns takes what a column holds and its name, e.g. x=NAME, got {text!r}")
    roles = {role: name for role, _, name in pairs}
    if len(roles) < len(pairs):
        raise InputError(f"--columns names something twice: {' '.join(columns)}")
    return roles or None
