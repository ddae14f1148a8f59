"""Count what is read, refused and wrong of random containers, ranked lists, joined logs and parts of channels.

A result is wrong if it differs from the plain form of the same measurements, or a refusal is more than one sentence.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from fuzz.containers import ATTEMPTS
from fuzz.test_fuzz import attack
from record import options, write_result


@dataclass(frozen=True)
class Config:
    """Number of inputs of each form."""

    inputs: int = 500


def main(asked: Config) -> None:
    """Read every input and write `results/fuzz_containers.json`."""
    done: dict[str, Any] = {}
    for kind in ATTEMPTS:
        ends, wrong = {"read": 0, "refused": 0}, list[str]()
        for seed in range(asked.inputs):
            with tempfile.TemporaryDirectory() as folder:
                try:
                    found = attack(kind, Path(folder), range(seed, seed + 1))
                except AssertionError as error:
                    wrong.append(str(error)[:200])
                else:
                    ends = {end: ends[end] + found[end] for end in ends}
        done[kind] = {"inputs": asked.inputs, **ends, "wrong": len(wrong), "first_wrong": wrong[:3]}
        print(kind, done[kind], flush=True)
    write_result("fuzz_containers", done)


if __name__ == "__main__":
    main(options(Config))
