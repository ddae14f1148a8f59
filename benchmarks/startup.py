"""Measure how long commands take from the command line: help, refusals, and whole runs.

python benchmarks/startup.py [--against CHECKOUT] [--only NAME...] [--without-avx512]

Rounds alternate between this checkout and the other one, so that other work on the machine slows both.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from record import options, write_result

HERE = Path(__file__).parent.parent
ROUNDS = 5
COMMANDS = {
    "import swiftwrf": ("-c", "import swiftwrf"),
    "swiftwrf --help": ("-m", "tasks.command", "--help"),
    **{
        f"tasks.{name} --help": ("-m", f"tasks.{name}", "--help")
        for name in ("aoa", "rssi", "locate", "report", "inspect", "convert", "estimate", "scenes", "view")
    },
    "unknown option": ("-m", "tasks.aoa", "--mix", "0.3", "--no-such-option"),
    "wrong value": ("-m", "tasks.aoa", "--mix", "2"),
    "tasks.rssi --rx 6": ("-m", "tasks.rssi", "--rx", "6", "--out", "run"),
    "tasks.aoa --mix 0.3": ("-m", "tasks.aoa", "--mix", "0.3", "--out", "run"),
}
FEW_ROUNDS = {"tasks.aoa --mix 0.3": 2}  # of commands that take a minute
AVX2_ALONE = {  # for torch and its libraries, NumPy and SciPy, and numba
    "ATEN_CPU_CAPABILITY": "avx2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
    "OPENBLAS_CORETYPE": "Haswell",
    "NUMBA_CPU_NAME": "haswell",
}


@dataclass(frozen=True)
class Config:
    """Seconds of commands: medians of 5 rounds after one that is not counted, of 2 for commands that take a minute."""

    against: Path | None = None
    """another checkout, measured in turn with this one"""
    only: tuple[str, ...] = tuple(COMMANDS)
    """commands to measure; the result has their rows alone"""
    without_avx512: bool = False
    """measure this checkout as on a processor without AVX-512, too"""


def seconds(checkout: Path, arguments: tuple[str, ...], instructions: dict[str, str]) -> float:
    """Return the time of one command of a checkout [s]."""
    with TemporaryDirectory() as folder:
        began, environment = time.perf_counter(), os.environ | {"PYTHONPATH": str(checkout)} | instructions
        subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, check=False)
        return time.perf_counter() - began


def main(config: Config) -> None:
    measured: dict[str, tuple[Path, dict[str, str]]] = {"this": (HERE, {})}
    if config.against:
        measured["other"] = config.against.resolve(), {}
    if config.without_avx512:
        measured["this, without AVX-512"] = HERE, AVX2_ALONE
    rows = []
    for name in config.only:
        arguments, rounds = COMMANDS[name], FEW_ROUNDS.get(name, ROUNDS)
        taken: dict[str, list[float]] = {checkout: [] for checkout in measured}
        for _ in range(rounds + 1):
            for checkout, (folder, instructions) in measured.items():
                taken[checkout].append(seconds(folder, arguments, instructions))
        for checkout, values in taken.items():
            wall = statistics.median(values[1:])
            rows.append({"command": name, "checkout": checkout, "rounds": rounds, "wall_s": wall})
            print(f"{name:<24} {checkout:<21} {wall:6.2f} s", flush=True)
    write_result("startup", {"rows": rows})


if __name__ == "__main__":
    main(options(Config))
