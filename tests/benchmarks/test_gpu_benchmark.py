"""Every part of the GPU benchmark on the CPU, and its script, which survives failures and timeouts of parts."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import gpu
import pytest
import torch

from swiftwrf.models import swiftwrf

SCRIPT = Path(gpu.__file__).with_name("gpu.sh")


@pytest.mark.parametrize("part", ["rates", "training", "profile", "launches"])
def test_every_part_leaves_its_result(part, tmp_path, monkeypatch):
    monkeypatch.setattr(swiftwrf, "CUTOFF", swiftwrf.CUTOFF)  # the benchmark sets another one
    gpu.main(gpu.Config(part, tmp_path, "cpu", quick=True, seconds=0.01))
    (file,) = tmp_path.iterdir()
    assert file.name == f"gpu_{part}.json"
    found = json.loads(file.read_text())
    assert found["quick"]
    assert "cores" in found["environment"]["device"]
    match part:
        case "rates":
            rates = [value for row in found["rows"] for value in row.values() if isinstance(value, dict)]
            assert len(rates) == 2 * 4
            assert all(0 < rate["low"] <= rate["median"] <= rate["high"] for rate in rates)
        case "training":
            assert len(found["seconds"]) == 3
        case "launches":
            assert 10 < found["operations"] < 100
        case "profile":
            assert found["counters"] == "no GPU"
            for row in found["rows"]:
                assert 0 < sum(row["model"]["kernels"].values()) <= 1
                assert f"N = {row['n']}" in row["limit"]


def test_targets_are_met_or_missed():
    rates = {"forward": 1.9e6, "forward_backward": 5e5, "model": 1.6e6, "synthesize": 1e5}
    row = {"n": 1000, "batch": 64} | {f"{name}_per_s": {"median": value} for name, value in rates.items()}
    slower = row | {"batch": 1, "forward_per_s": {"median": 1.0}}
    assert {target["what"]: target["met"] for target in gpu.targets([slower, row])} == {
        "forward, N = 1000": True,
        "forward_backward, N = 1000": False,
        "model, of forward, N = 1000": True,
        "synthesize, of forward, N = 1000": False,
    }


STAND_IN = """#!/usr/bin/env bash
case "$*" in
  *torch.cuda* | *"import pytest"*) exit 1 ;;
  *pytest*cuda*) echo "a test failed"; exit 1 ;;
  *rasterize.py*) sleep 60 ;;
  *) echo "$*" ;;
esac
"""


@pytest.mark.skipif(shutil.which("timeout") is None, reason="needs timeout of GNU coreutils")
def test_a_part_that_fails_or_hangs_costs_no_other(tmp_path):
    python, folder = tmp_path / "python", tmp_path / "results"
    python.write_text(STAND_IN)
    python.chmod(0o755)
    began = SCRIPT.read_text()
    assert "part rasterize 150 " in began
    script = tmp_path / "benchmarks" / "gpu.sh"
    script.parent.mkdir()
    script.write_text(began.replace("part rasterize 150 ", "part rasterize 1 "))
    environment = os.environ | {"PYTHON": str(python), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        ["bash", str(script), str(folder)], env=environment, capture_output=True, text=True, check=True
    )
    states = {row["part"]: row["state"] for row in json.loads((folder / "gpu_parts.json").read_text())}
    assert states.pop("tests") == "failed with code 1"
    assert states.pop("rasterize") == "stopped after 1 s"
    assert states.pop("sanitizer") == "left out: compute-sanitizer is not installed"
    parts = ("environment", "install", "rates", "profile", "training")
    assert states == dict.fromkeys(parts, "done")
    assert "--editable .[dev]" in (folder / "gpu_install.log").read_text()
    assert (folder / "gpu_tests.log").read_text() == "a test failed\n"
    assert "--device cpu --quick" in (folder / "gpu_rates.log").read_text()
    assert "tiny sizes on the CPU" in done.stdout


@pytest.mark.cuda
def test_bounds_of_the_gpu(tmp_path):
    gpu.main(gpu.Config("profile", tmp_path, "cuda", quick=True, seconds=0.01))
    found = json.loads((tmp_path / "gpu_profile.json").read_text())
    assert torch.cuda.get_device_name() == found["environment"]["device"]
    assert all(0 < bound < 1 for row in found["rows"] for bound in row["share_of_bounds"].values())
