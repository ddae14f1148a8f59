"""Command lines as people mistype them and as hostile tools write them. None of them starts a long run: whatever is valid
meets an `--out` that is taken, or fails its check."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

VALUES = [
    "", "0", "1", "-1", "0.5", "1.5", "nan", "inf", "-inf", "1e400", "1e-320", "4294967296", "99999999999999999999",
    "all", "x", "random", "block", "nowhere", "--", "-", "\u00e4", "\udcff", "a\nb", "$x^{$", "=1", "x" * 300, ".", "..",
    "/", "/dev/null", "/proc/1/mem", "tcp://127.0.0.1:1", "tls://127.0.0.1:1", "none", "auto", "cpu", "paper", "True",
    "[1]", "{}", "nearest", "swiftwrf", "*",
]  # fmt: skip
BOTH = ("--data", "--split", "--preset", "--seed", "--device", "--resume")
OPTIONS = {
    "aoa": ("--mix", "--synthesizer", "--array", "--repeats", *BOTH),
    "rssi": ("--rx", "--floor-plan", "--floor-extent", "--scheduler", *BOTH),
    "report": ("--out", "--resume"),
}
NEEDED = {"aoa": ["--mix", "0.5"], "rssi": ["--rx", "1"], "report": ["run"]}


def command_lines(draw: random.Random, folder: Path, count: int) -> Iterator[tuple[str, list[str]]]:
    """So many of them, with paths inside the folder."""
    taken, broken = folder / "taken", folder / "broken.partial"
    taken.mkdir()
    broken.mkdir()
    (broken / "config.json").write_text('{"task": "rssi", "config": {}}')
    (folder / "data").mkdir()
    values = [*VALUES, str(taken), str(broken), str(folder / "data")]
    for _ in range(count):
        task = draw.choice(list(OPTIONS))
        arguments = list(NEEDED[task]) if draw.random() < 0.8 else []
        for _ in range(draw.randint(0, 3)):
            arguments.append(draw.choice(OPTIONS[task]))
            arguments += [draw.choice(values) for _ in range(draw.choice([0, 1, 1, 1, 2, 3, 4]))]
        if draw.random() < 0.1:
            arguments.append(draw.choice(values))
        yield task, [*arguments, "--out", str(taken)]
