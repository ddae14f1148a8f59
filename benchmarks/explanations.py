"""Count the true and the false causes that are named in random scenes: the long version of tests/.../test_diagnosis.py."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "swiftwrf" / "contrib" / "diagnostics"))

import test_diagnosis as diagnosis
from record import options, write_result

from swiftwrf.contrib.diagnostics.frames import check_frames
from swiftwrf.data import Snapshots


@dataclass(frozen=True)
class Config:
    """Number of scenes of each cause. They are inspected for the known causes, or for errors that have no name."""

    kind: Literal["known", "unknown"] = "known"
    scenes: int = 25


def main(asked: Config) -> None:
    """Inspect every scene and write `results/explanations_KIND.json`."""
    done: dict[str, Any] = {}
    for name in diagnosis.CAUSES if asked.kind == "known" else diagnosis.UNKNOWN:
        if asked.kind == "known":
            right = sum(is_right(name, seed) for seed in range(asked.scenes))
            done[name] = {"scenes": asked.scenes, "right": right}
        else:
            found = [causes(diagnosis.UNKNOWN[name](seed)) for seed in range(100, 100 + asked.scenes)]
            false = sum(any("rotation" not in cause for cause in each) for each in found)
            done[name] = {"scenes": asked.scenes, "false": false, "rotations": sum(map(len, found)) - false}
        print(name, done[name], flush=True)
        write_result(f"explanations_{asked.kind}", done)


def causes(data: Snapshots) -> list[str]:
    """Return the causes that are named of an error of frames, elements or labels."""
    numbers = check_frames(data.spectra(diagnosis.GRID), data)[2]
    return [*numbers["explanations"], *(["constant rotation of"] if numbers["turn_deg"] else [])]


def is_right(name: str, seed: int) -> bool:
    """Return True if the true cause is named and no other one."""
    try:
        diagnosis.check(name, seed)
    except AssertionError:
        return False
    return True


if __name__ == "__main__":
    main(options(Config))
