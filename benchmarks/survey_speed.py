"""Seconds and memory of commands and of surveys of many receivers and rows, beside those of another checkout.

python benchmarks/survey_speed.py first receivers scans --against DIR

Each case runs with the threads and processes that it has by default, first with the code of this commit, then with that of
`--against`. Nothing else should run on the machine. `peak_gib` is the memory of the largest process. `workers` is
`swiftwrf rssi` on 600 scans of 60 receivers, on a Dask cluster of this machine with 1, 2 and 4 workers.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from profiles import write_channels
from record import ROOT, kept, options, write_result

Case = Literal[
    "first", "one", "aoa", "packets", "map", "receivers", "scans", "channels", "locate", "circular", "workers"
]
GIB = 2**20  # in kibibytes
N_WORKERS = (1, 2, 4)
LOCATE = """
import json, sys, time, numpy as np, swiftwrf
data = swiftwrf.load_rssi(sys.argv[1])
train, scans = data[:1000], data[1000:].rssi_dbm
locator = swiftwrf.RssiLocator().fit(train)
began = time.perf_counter()
for rows in scans.split(125):
    found = locator.locate(rows)
    found.median, [found.credible_radius(level) for level in (0.5, 0.8, 0.95)], found.ambiguous
print(json.dumps({"seconds": time.perf_counter() - began}))
"""
CHANNELS = """
import json, sys, time, swiftwrf
data = swiftwrf.load_spectra(sys.argv[1])
locator = swiftwrf.MatchedField().fit(data[:100])
began = time.perf_counter()
locator.locate(data[100:]).median
print(json.dumps({"seconds": time.perf_counter() - began}))
"""
MAP = "import sys, swiftwrf; print(swiftwrf.fit_rssi(swiftwrf.load_rssi(sys.argv[1])))"
READ = "import sys, swiftwrf; print(len(swiftwrf.load_rssi(sys.argv[1])))"


@dataclass(frozen=True)
class Config:
    cases: Annotated[tuple[Case, ...], tyro.conf.Positional]
    """first: README's first command; one: rssi --rx 6; aoa: aoa --mix 0.3; packets: reading rows of a long table; map:
    fit_rssi on 2,000 rows of 100 receivers; receivers: rssi on them; scans: 1,000 scans located among 500 receivers;
    channels: 200 channels of 8 subcarriers located in the office; locate: swiftwrf locate on a survey with a published
    split; circular: aoa --mix 0.7 on channels of a circular array; workers: rssi on a cluster. Earlier results are kept"""
    against: Path | None = None
    """another checkout"""
    data: Path | None = None
    """survey of `locate`, or channels of `circular`"""
    n_packets: int = 5_000_000
    """rows of `packets`"""
    repeats: int = 1
    """runs of a case in each checkout, in turn; medians are written"""


def main(config: Config) -> None:
    """Measure each case and write `results/survey_speed.json`."""
    for case in config.cases:
        name = f"{case} {config.data.name}" if case in ("locate", "circular") and config.data else case
        with TemporaryDirectory() as folder:
            found = workers(Path(folder)) if case == "workers" else measured(case, Path(folder), config)
        print(name, json.dumps(found), flush=True)
        cases = dict(kept("survey_speed", "cases")) | {name: found}
        write_result("survey_speed", {"cases": dict(sorted(cases.items()))}, rows=[found])


def measured(case: Case, folder: Path, config: Config) -> dict[str, Any]:
    """Return seconds and peak memory of a case in this checkout, and in the other one."""
    arguments = command(case, folder, config)
    checkouts = {"here": ROOT} | ({} if config.against is None else {"against": config.against})
    runs = [{name: run(arguments, folder, of) for name, of in checkouts.items()} for _ in range(config.repeats)]
    return {name: {key: median(one[name][key] for one in runs) for key in runs[0][name]} for name in checkouts}


def command(case: Case, folder: Path, config: Config) -> list[str]:
    """Write the data of a case and return the arguments of Python."""
    match case:
        case "first":
            return ["-m", "tasks", "rssi", "--rx", "all"]
        case "one":
            return ["-m", "tasks", "rssi", "--rx", "6"]
        case "aoa":
            return ["-m", "tasks", "aoa", "--mix", "0.3"]
        case "channels":
            write_channels(folder / "channels", 300, 8)
            return ["-c", CHANNELS, str(folder / "channels")]
        case "circular":
            (folder / "reading.yaml").write_text("grid: [16, 72]\n")
            return ["-m", "tasks", "aoa", "--mix", "0.7", "--data", str(config.data), "--read", "reading.yaml"]
        case "packets":
            return ["-c", READ, str(write_packets(folder / "survey.csv", config.n_packets))]
        case "map":
            return ["-c", MAP, str(write_survey(folder / "survey", 2000, 100))]
        case "receivers":
            return ["-m", "tasks", "rssi", "--rx", "all", "--data", str(write_survey(folder / "survey", 2000, 100))]
        case "scans":
            return ["-c", LOCATE, str(write_survey(folder / "survey", 2000, 500))]
        case _:
            return ["-m", "tasks", "locate", "--data", str(config.data), "--split", "published", "--rx", "all"]


def run(arguments: list[str], folder: Path, checkout: Path) -> dict[str, float]:
    """Run Python with the code of a checkout; what it prints as JSON replaces seconds of the whole process."""
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    output = folder / "output.txt"
    with output.open("w") as stream:
        began = time.perf_counter()
        process = subprocess.Popen([sys.executable, *arguments], cwd=folder, env=environment, stdout=stream)
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - began
    if status:
        raise SystemExit(f"{arguments} in {checkout} ended with {os.waitstatus_to_exitcode(status)}")
    found = {"seconds": seconds, "peak_gib": usage.ru_maxrss / GIB}
    last = output.read_text().splitlines()[-1]
    return found | (json.loads(last) if last.startswith("{") else {})


def workers(folder: Path) -> dict[str, Any]:
    """Return seconds of a run on a cluster by its number of workers, and the efficiency of each number."""
    from distributed import LocalCluster

    data, seconds = write_survey(folder / "survey", 600, 60), {}
    arguments = ["-m", "tasks", "rssi", "--rx", "all", "--data", str(data)]
    for number in N_WORKERS:
        with LocalCluster(n_workers=number, threads_per_worker=1, dashboard_address=None) as cluster:
            cluster.wait_for_workers(number)
            seconds[number] = run([*arguments, "--scheduler", cluster.scheduler_address], folder, ROOT)["seconds"]
    efficiency = {number: seconds[1] / (number * each) for number, each in seconds.items()}
    return {"seconds": seconds, "efficiency": efficiency, "processors": os.cpu_count()}


def powers(position: np.ndarray, n_receivers: int, seed: int) -> np.ndarray:
    """Return RSSI (n, R) [dBm] at positions (n, 3) [m] on a floor of 100 x 60 m, nan below -90 dBm."""
    draw = np.random.default_rng(seed)
    receiver = draw.uniform([0, 0, 2], [100, 60, 3], (n_receivers, 3))
    distance = np.linalg.norm(position[:, None] - receiver, axis=2)
    wave = draw.normal(size=(2, n_receivers, 8)) / 8  # [rad/m] of a field that the path loss does not explain
    phase = np.einsum("nk,krw->nrw", position[:, :2], wave) + draw.uniform(0, 2 * np.pi, (n_receivers, 8))
    power = -40 - 32 * np.log10(np.maximum(distance, 1)) + 2 * np.sin(phase).sum(axis=2)
    power = np.round(power + draw.normal(0, 3, power.shape))
    return np.where(power < -90, np.nan, power)


def write_survey(folder: Path, n_rows: int, n_receivers: int) -> Path:
    """Write a wide table of scans at random positions, and return its folder."""
    folder.mkdir()
    position = np.random.default_rng(0).uniform([0, 0, 1], [100, 60, 1.001], (n_rows, 3)).round(3)
    names = ["x", "y", "z", *(f"ap{number:03d}" for number in range(n_receivers))]
    rows = np.concatenate([position, powers(position, n_receivers, 1)], axis=1)
    text = [",".join("" if np.isnan(value) else f"{value:g}" for value in row) for row in rows]
    (folder / "survey.csv").write_text("\n".join([",".join(names), *text]) + "\n")
    return folder


def write_packets(file: Path, n_rows: int) -> Path:
    """Write a long table of packets at 20 receivers along a walk, and return it."""
    n_places = n_rows // 20
    time_s = np.arange(n_places) / 10
    position = np.stack([50 + 45 * np.sin(0.01 * time_s), 30 + 25 * np.sin(0.017 * time_s), 0 * time_s + 1], axis=1)
    with file.open("w") as stream:
        stream.write("time,x,y,z,receiver,rssi\n")
        for part in np.array_split(np.arange(n_places), max(1, n_places // 10_000)):
            power = np.nan_to_num(powers(position[part], 20, 1), nan=-90)
            for second, (x, y, z), values in zip(time_s[part], position[part], power, strict=True):
                stream.writelines(
                    f"{second:.1f},{x:.3f},{y:.3f},{z:.1f},ap{number:02d},{value:.0f}\n"
                    for number, value in enumerate(values)
                )
    return file


if __name__ == "__main__":
    main(options(Config))
