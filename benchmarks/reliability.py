"""Attack readers, commands and runs and record how they end: the long version of tests/fuzz and test_interrupts.py."""

from __future__ import annotations

import contextlib
import io
import os
import random
import sys
import tempfile
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "tasks"))

import test_interrupts as interrupts
from fuzz.commands import command_lines, right_command_lines
from fuzz.kinds import ATTEMPTS, KINDS
from fuzz.test_fuzz import SHORT, attack
from quick import run
from record import options, write_result

PAGES = [kind for kind in KINDS if kind.endswith("on the page")]
CommandLines = Callable[[random.Random, Path, int], Iterator[tuple[str, list[str]]]]


@dataclass(frozen=True)
class Config:
    """Numbers of attacks of each kind."""

    mutations: int = 10_000
    attempts: int = 5_000
    commands: int = 200
    right: int = 20
    kills: int = 50
    disks: int = 10
    races: int = 5


def main(asked: Config) -> None:
    """Make every attack and write `results/reliability.json`."""
    root, done = Path(tempfile.mkdtemp()), {}
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "mutations": lambda: mutations(root, KINDS, asked.mutations),
        "attempts": lambda: mutations(root, [*ATTEMPTS, *PAGES], asked.attempts),
        "commands": lambda: commands(root / "commands", command_lines, asked.commands),
        "right": lambda: commands(root / "right", right_command_lines, asked.right),
        "kills": lambda: kills(root, asked.kills),
        "disks": lambda: disks(root, asked.disks),
        "races": lambda: races(root, asked.races),
    }
    for name, part in parts.items():
        done[name] = part()
        print(name, done[name], flush=True)
        write_result("reliability", done)


def mutations(root: Path, kinds: Collection[str], count: int) -> dict[str, Any]:
    """Attack every kind, with seeds that the tests do not use."""
    ends: dict[str, Any] = {}
    for kind in kinds:
        seeds = range(SHORT, SHORT + -(-count // len(kinds)))
        try:
            ends[kind] = attack(kind, root / kind.replace(" ", "-"), seeds) | {"wrong": 0}
        except AssertionError as error:
            ends[kind] = {"wrong": 1, "what": str(error)}
            print(error, flush=True)
    return ends


def commands(folder: Path, lines: CommandLines, count: int) -> dict[str, int]:
    """Run command lines in this process; count exit codes, and tracebacks as wrong."""
    ends = {"exit 0": 0, "exit 1": 0, "exit 2": 0, "wrong": 0}
    folder.mkdir()
    with contextlib.chdir(folder):
        for task, arguments in lines(random.Random(2), folder, count):
            said = io.StringIO()
            try:
                with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
                    code = run(task, *arguments)
            except SystemExit as end:
                code = int(end.code or 0)
            except BaseException as error:
                print(task, arguments, repr(error))
                code = -1
            ends[f"exit {code}" if f"exit {code}" in ends else "wrong"] += 1
    return ends


def kills(root: Path, count: int) -> dict[str, int]:
    """Kill runs at random moments and resume them, until their tables can be compared with those of whole runs."""
    draw, ends = random.Random(3), {"kills": 0, "runs": 0, "wrong": 0}
    wholes = {asked: interrupts.whole_run(root / asked[0], asked) for asked in (interrupts.RSSI, interrupts.AOA)}
    while ends["kills"] < count:
        asked = (interrupts.AOA, interrupts.RSSI)[ends["runs"] % 2]
        folder = root / f"kill{ends['runs']}"
        folder.mkdir()
        try:
            ends["kills"] += interrupts.kill_until_done(
                folder, asked, wholes[asked], draw, min(10, count - ends["kills"])
            )
        except AssertionError as error:
            print(error)
            ends["wrong"] += 1
        ends["runs"] += 1
        print(ends, flush=True)
    return ends


def disks(root: Path, count: int) -> dict[str, int]:
    """Limit the size of files at random, then resume the run without the limit."""
    draw, wrong = random.Random(4), 0
    for number in range(count):
        try:
            whole = root / "rssi" / "whole"
            interrupts.fill_disk(root / f"disk{number}", interrupts.RSSI, whole, draw.randint(100, 12_000))
        except AssertionError as error:
            print(error)
            wrong += 1
    return {"full disks": count, "wrong": wrong}


def races(root: Path, count: int) -> dict[str, int]:
    """Start two processes with the same --out."""
    wrong = 0
    for number in range(count):
        try:
            interrupts.race(root / f"race{number}", interrupts.RSSI, 2)
        except AssertionError as error:
            print(error)
            wrong += 1
    return {"races": count, "wrong": wrong}


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main(options(Config))
