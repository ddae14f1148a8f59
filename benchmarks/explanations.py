"""Count the true and the false causes that are named in random scenes: the long version of tests/.../test_diagnosis.py."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "swiftwrf" / "diagnostics"))

import test_diagnosis as diagnosis
from record import options, write_result

from swiftwrf.data import Snapshots
from swiftwrf.diagnostics.frames import check_frames


@dataclass(frozen=True)
class Config:
    """Numbers of scenes of each cause that has a name, and of each that has none."""

    known: int = 25
    unknown: int = 40


def main(asked: Config) -> None:
    """Inspect every scene and write `results/explanations.json`."""
    done: dict[str, Any] = {"known": {}, "unknown": {}}
    for name, (make, expected) in diagnosis.CAUSES.items():
        right = sum(is_right(name, make, expected, seed) for seed in range(asked.known))
        done["known"][name] = {"scenes": asked.known, "right": right}
        print(name, done["known"][name], flush=True)
        write_result("explanations", done)
    for name, make in diagnosis.UNKNOWN.items():
        seeds = range(100, 100 + asked.unknown)
        false = sum(any("rotation" not in cause for cause in causes(make(seed))) for seed in seeds)
        done["unknown"][name] = {"scenes": asked.unknown, "false": false}
        print(name, done["unknown"][name], flush=True)
        write_result("explanations", done)


def causes(data: Snapshots) -> list[str]:
    """Return the causes that are named of an error of frames, elements or labels."""
    report = check_frames(data.spectra(diagnosis.GRID), data)
    assert report is not None
    return [*report.explanations, *(["constant rotation of"] if report.turn_deg else [])]


def is_right(name: str, make: Callable[[int], Snapshots], expected: str, seed: int) -> bool:
    """Return True if the true cause is named and no other one."""
    if name not in diagnosis.OF_INSPECTION:
        found = causes(make(seed))
        return bool(found) and all(expected in cause for cause in found)
    try:
        diagnosis.check(name, seed)
    except AssertionError:
        return False
    return True


if __name__ == "__main__":
    main(options(Config))
