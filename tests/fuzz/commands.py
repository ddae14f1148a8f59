"""Command lines as people mistype them and as hostile tools write them, and some that are right.

Those that are mistyped start no long run: whatever is valid among them meets an `--out` that is taken, or fails its check.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

from quick import TASKS

VALUES = [
    "", "0", "1", "-1", "0.5", "1.5", "nan", "inf", "-inf", "1e400", "1e-320", "4294967296", "99999999999999999999",
    "all", "x", "random", "block", "nowhere", "--", "-", "\u00e4", "\udcff", "a\nb", "$x^{$", "=1", "x" * 300, ".", "..",
    "/", "/dev/null", "/proc/1/mem", "tcp://127.0.0.1:1", "tls://127.0.0.1:1", "none", "auto", "cpu", "paper", "True",
    "[1]", "{}", "nearest", "swiftwrf", "receiver", "*",
]  # fmt: skip
OPTIONS = {
    task: ("--resume", *(f"--{option.name.replace('_', '-')}" for option in fields(config)))
    for task, (config, _) in TASKS.items()
}
REQUIRED_OPTIONS = {
    "aoa": ["--mix", "0.5"],
    "rssi": ["--rx", "1"],
    "report": ["run"],
    "convert": ["data", "taken"],
    "inspect": ["data"],
    "view": ["data"],
    "scenes": ["--room", "office", "--moving", "receiver", "--positions", "5"],
    "estimate": ["data", "data"],
    "locate": ["--cells", "100"],
}
RIGHT = {
    "aoa": {
        "--mix": ("0.5", "1", "0.45 0.9"),
        "--synthesizer": ("nearest", "idw nearest"),
        "--extra": ("0", "7"),
        "--suggest": ("3",),
        "--moving": ("transmitter", "receiver"),
        "--split": ("random", "block"),
        "--repeats": ("1", "2"),
        "--seed": ("0", "4294967290"),
    },
    "rssi": {
        "--rx": ("1", "receiver06 2", "all"),
        "--split": ("random", "block"),
        "--seed": ("0", "4294967295"),
    },
    "locate": {
        "--rx": ("1", "receiver06 2", "all"),
        "--split": ("random", "block"),
        "--cells": ("10", "100"),
        "--seed": ("0", "4294967295"),
    },
}


def command_lines(draw: random.Random, folder: Path, count: int) -> Iterator[tuple[str, list[str]]]:
    """Yield `count` random command lines with paths inside the folder."""
    taken, broken = folder / "taken", folder / "broken.partial"
    taken.mkdir()
    broken.mkdir()
    (broken / "config.json").write_text('{"task": "rssi", "config": {}}')
    (folder / "data").mkdir()
    values = [*VALUES, str(taken), str(broken), str(folder / "data")]
    for _ in range(count):
        task = draw.choice(list(OPTIONS))
        arguments = list(REQUIRED_OPTIONS[task]) if draw.random() < 0.8 else []
        for _ in range(draw.randint(0, 3)):
            arguments.append(draw.choice(OPTIONS[task]))
            arguments += [draw.choice(values) for _ in range(draw.choice([0, 1, 1, 1, 2, 3, 4]))]
        if draw.random() < 0.1:
            arguments.append(draw.choice(values))
        yield task, arguments if task in ("convert", "view") else [*arguments, "--out", str(taken)]


def right_command_lines(draw: random.Random, folder: Path, count: int) -> Iterator[tuple[str, list[str]]]:
    """Yield `count` valid command lines, each a short run into a separate directory."""
    for number in range(count):
        task = draw.choice(list(RIGHT))
        (needed, values), *others = RIGHT[task].items()
        arguments = [needed, *draw.choice(values).split()]
        for option, values in draw.sample(others, draw.randint(0, len(others))):
            arguments += [option, *draw.choice(values).split()]
        yield task, [*arguments, "--out", str(folder / f"run{number}")]
