"""Measure the time to read own files, and the accuracy of an array calibration from them.

python benchmarks/own_files.py
"""

from __future__ import annotations

import math
import os
import resource
import sys
import tempfile
import time
from pathlib import Path
from subprocess import run
from typing import Any

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "swiftwrf/diagnostics"))

import numpy as np
import pandas as pd
import torch
from record import check_committed, write_result
from samples import snapshots, write_snapshots
from test_calibration import errors, spoilt

from swiftwrf import calibrate, load_spectra, rssi_room
from swiftwrf.array.beamforming import BEAMFORMERS

ROWS, POSITIONS, SNAPSHOTS = 5000, 1000, 64
ECHOES, DRAWS = (0.0, 0.05, 0.1, 0.2), 5


def survey(folder: Path) -> dict[str, Any]:
    """Return the time of one command from a CSV of 5,000 rows and 12 receivers to a map."""
    data = rssi_room(n=ROWS)
    table = pd.DataFrame(data.transmitter_position.numpy(), columns=list("xyz"))
    for number, name in enumerate(data.receiver_names):
        table[name] = data.rssi_dbm[:, number]
    table.to_csv(folder / "survey.csv", index=False)
    command = ["-m", "tasks.rssi", "--data", str(folder / "survey.csv"), "--rx", "all", "--out", str(folder / "run")]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    run([sys.executable, *command], check=True, cwd=Path(__file__).parent.parent)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "rows": ROWS,
        "receivers": len(data.receiver_names),
        "wall_s": time.perf_counter() - began,
        "processor_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "report_mib": (folder / "run" / "report.html").stat().st_size / 2**20,
    }


def spectra(folder: Path) -> list[dict[str, Any]]:
    """Return the time from snapshots of 16 elements on disk to spectra of 90 x 360 pixels, for each beamformer."""
    write_snapshots(folder / "snapshots", data=snapshots(n=POSITIONS, count=SNAPSHOTS))
    rows = []
    for name in BEAMFORMERS:
        began, busy = time.perf_counter(), time.process_time()
        data = load_spectra(folder / "snapshots", beamformer=name)
        seconds = {"wall_s": time.perf_counter() - began, "processor_s": time.process_time() - busy}
        rows.append({"beamformer": name, "shape": list(data.spectrum.shape), "snapshots": SNAPSHOTS, **seconds})
    return rows


def calibration() -> list[dict[str, Any]]:
    """Return median and largest errors [deg] of calibrations over draws of noise, element phases and rotation.

    The phases are 0 to 2 pi, the rotation is 20 degrees; 300 positions at 14 dB, with an echo from the floor.
    """
    rows = []
    for echo in ECHOES:
        found = []
        for seed in range(DRAWS):
            data, phase, turn = spoilt(snapshots(n=300, noise=0.2, echo=echo, seed=seed), seed=seed)
            began = time.perf_counter()
            estimate = calibrate(data)
            spread = [math.degrees(float(x.max())) for x in (estimate.turn_std, estimate.phase_std)]
            found.append([*errors(estimate, phase, turn), *spread, time.perf_counter() - began])
        middle, most = np.median(found, axis=0).tolist(), np.max(found, axis=0).tolist()
        names = ("turn_deg", "phase_deg", "turn_std_deg", "phase_std_deg", "seconds")
        rows.append(
            {
                "echo": echo,
                "median": dict(zip(names, middle, strict=True)),
                "largest": dict(zip(names, most, strict=True)),
            }
        )
    return rows


def main() -> None:
    """Measure everything and write `results/own_files.json`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        content = {"survey": survey(folder), "spectra": spectra(folder), "calibration": calibration()}
    content |= {"threads": torch.get_num_threads(), "load": os.getloadavg()[0]}
    write_result("own_files", content)


if __name__ == "__main__":
    check_committed()
    main()
