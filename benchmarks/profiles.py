"""Processor seconds of a command and of its functions, in one process and thread.

python benchmarks/profiles.py channels
python benchmarks/profiles.py locate --data DIR

`channels` is `swiftwrf aoa --mix 0.5` on 160 channels of 16 elements and 16 subcarriers in the simulated office, which it
writes first. `locate` is `swiftwrf locate` on a survey. A row of the table is a function whose own calls and those below it
take a twentieth of the time or more. Seconds of the command are those of a run without profiler.
"""

from __future__ import annotations

import cProfile
import pstats
import time
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro
from record import RESULTS, options, write_result

from swiftwrf.array.planar import PlanarArray
from swiftwrf.data.simulated import OFFICE, OFFICE_REGION, STATIONS
from tasks.command import main as swiftwrf

N_POSITIONS, N_SUBCARRIERS, BANDWIDTH_HZ, SNR_DB = 160, 16, 20e6, 20.0
PACKAGES = ("swiftwrf", "augment", "tasks")
MIN_SHARE = 0.05  # of the rows of the table


@dataclass(frozen=True)
class Config:
    commands: Annotated[tuple[Literal["channels", "locate"], ...], tyro.conf.Positional] = ("channels",)
    """commands that are measured"""
    data: Path | None = None
    """survey of `locate`"""
    name: str = "profiles"
    """name of the result"""
    out: Path = RESULTS
    """folder of the result"""


def main(config: Config) -> None:
    """Run each command twice, without and with the profiler, and write the result."""
    torch.set_num_threads(1)
    found = {}
    for name in config.commands:
        with TemporaryDirectory() as folder:
            found[name] = measured(name, Path(folder), config)
        print(name, f"{found[name]['seconds']:.0f} s", *found[name]["functions"][:12], sep="\n", flush=True)
        write_result(config.name, found, folder=config.out)


def measured(name: str, folder: Path, config: Config) -> dict[str, Any]:
    """Return processor seconds of a command, and of its functions."""
    if name == "channels":
        write_channels(folder / "data")
        command = ["aoa", "--mix", "0.5", "--data", str(folder / "data"), "--processes", "1"]
    else:
        command = ["locate", "--data", str(config.data)]
    began = time.process_time()
    assert swiftwrf([*command, "--quiet", "--out", str(folder / "plain")]) == 0
    seconds = time.process_time() - began
    profile = cProfile.Profile(time.process_time)
    profile.runcall(swiftwrf, [*command, "--quiet", "--out", str(folder / "profiled")])
    return {"command": " ".join(command[:3]), "seconds": seconds, "functions": functions(pstats.Stats(profile))}


def functions(stats: pstats.Stats) -> list[dict[str, Any]]:
    """Return the functions of this project with a twentieth of the time or more, below each other, the longest first."""
    rows = []
    total = stats.total_tt  # type: ignore[attr-defined]
    for (file, _, function), (_, calls, own, cumulative, _) in stats.stats.items():  # type: ignore[attr-defined]
        parts = Path(file).with_suffix("").parts
        package = next((n for n, part in enumerate(parts) if part in PACKAGES), None)
        if package is not None and cumulative >= MIN_SHARE * total:
            place = ".".join(parts[package:])
            rows.append(
                {"function": f"{place}.{function}", "calls": calls, "own": own / total, "below": cumulative / total}
            )
    return sorted(rows, key=lambda row: -row["below"])


def write_channels(folder: Path, n_positions: int = N_POSITIONS, n_subcarriers: int = N_SUBCARRIERS) -> None:
    """Write channels of one array in the simulated office as snapshots.npz."""
    folder.mkdir()
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(OFFICE_REGION, dtype=torch.float64)
    position = low + (high - low) * torch.rand(n_positions, 3, dtype=torch.float64, generator=generator)
    pose, array = STATIONS["west"], PlanarArray.square(4, OFFICE.frequency_hz)
    paths = OFFICE.paths(position, torch.tensor(pose.position, dtype=torch.float64))
    paths = replace(paths, direction=paths.direction @ pose.rotation)
    channel, frequency = paths.subcarriers(array, n_subcarriers, BANDWIDTH_HZ)
    std = channel.abs().square().mean().sqrt() * 10 ** (-SNR_DB / 20)
    channel = channel + std * torch.randn(channel.shape, dtype=channel.dtype, generator=generator)
    np.savez(
        folder / "snapshots.npz",
        csi=channel.numpy(),
        position=position.numpy(),
        frequency_hz=frequency.numpy(),
        array_position=np.array(pose.position),
        array_orientation=np.array(pose.orientation),
        rows=4,
        columns=4,
        spacing_m=array.wavelength / 2,
    )


if __name__ == "__main__":
    main(options(Config))
