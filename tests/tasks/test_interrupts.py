"""Runs that are killed, run into a full disk or into each other: nothing finished is lost, and the numbers are the same."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
import quick

pytestmark = pytest.mark.long
HERE = Path(__file__).parents[1]
AOA = ("aoa", "--mix", "0.5", "--extra", "20")
RSSI = ("rssi", "--rx", "1")
TABLES = {"aoa": ("errors.csv", "synthesis.csv"), "rssi": ("errors.csv", "predictions.csv")}
TIMES = ["seconds", "elapsed"]  # columns of the history that no two runs share


def start(folder, *arguments, most_bytes=None):
    """A task on toys in a process of its own; `most_bytes` stands for a full disk: no file may become larger."""
    limit = (
        f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({most_bytes}, {most_bytes}))\n"
        if most_bytes
        else ""
    )
    ignore = "import signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"  # so that a write fails instead
    code = f"{limit}{ignore}import sys, quick\nsys.exit(quick.run(*sys.argv[1:]))"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent)])}
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        cwd=folder,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(process):
    """Return the exit code and the last line of stderr; a traceback fails the test."""
    _, said = process.communicate(timeout=300)
    assert "Traceback" not in said, said[-2000:]
    return process.returncode, said


def same_results(task, whole, cut):
    """Tables byte for byte, histories but for their seconds."""
    for name in TABLES[task]:
        assert (cut / name).read_bytes() == (whole / name).read_bytes(), name
    if task == "aoa":
        histories = [pd.read_csv(run / "history.csv").drop(columns=TIMES, errors="ignore") for run in (whole, cut)]
        pd.testing.assert_frame_equal(*histories)
    assert (cut / "report.html").exists()
    assert not (cut / "steps").exists()


def wait_for(process, environment, since):
    """Until this start of the run is under way (it has written its environment since then), or over."""
    while process.poll() is None and not (environment.exists() and environment.stat().st_mtime > since):
        time.sleep(0.01)


def kill_until_done(folder, asked, whole, draw, kills):
    """Starts a run and kills it at random moments, each start but the last; then lets it finish. How often it was hit."""
    out, hit = folder / "cut", 0
    arguments = (*asked, "--out", out)
    partial = out.with_name("cut.partial")
    while hit < kills and not out.exists():
        since = time.time()
        process = start(folder, *arguments)
        wait_for(process, partial / "environment.json", since)
        time.sleep(draw.uniform(0, 3))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        hit += process.returncode == -signal.SIGKILL
        if (partial / "config.json").exists():
            arguments = ("resume", partial)
    if not out.exists():
        assert quick.run(*arguments) == 0
    same_results(asked[0], whole, out)
    return hit


def whole_run(folder, asked):
    assert quick.run(*asked, "--out", folder / "whole") == 0
    return folder / "whole"


@pytest.mark.parametrize("asked", [pytest.param(AOA, marks=pytest.mark.fuzz), RSSI], ids=["aoa", "rssi"])
def test_a_killed_run_goes_on_to_the_same_tables(tmp_path, asked):
    whole = whole_run(tmp_path, asked)
    assert kill_until_done(tmp_path, asked, whole, random.Random(1), 2) <= 2


def fill_disk(folder, asked, whole, most_bytes):
    """A run that may write no file larger than so much, then one that may."""
    folder.mkdir()
    code, said = finished(start(folder, *asked, "--out", folder / "cut", most_bytes=most_bytes))
    assert code == 2, said
    assert "no space left" in said, said
    assert not (folder / "cut").exists()
    has_begun = (folder / "cut.partial" / "config.json").exists()
    assert quick.run(*(("resume", folder / "cut.partial") if has_begun else (*asked, "--out", folder / "cut"))) == 0
    same_results(asked[0], whole, folder / "cut")


@pytest.mark.fuzz
def test_a_full_disk_ends_in_a_sentence_and_the_run_goes_on(tmp_path):
    whole = whole_run(tmp_path, RSSI)
    fill_disk(tmp_path / "b", RSSI, whole, 3000)


def race(folder, asked, count):
    """Start `count` processes with one --out at the same time; all but one are refused."""
    folder.mkdir(exist_ok=True)
    started = [start(folder, *asked, "--out", folder / "same") for _ in range(count)]
    codes = sorted(finished(process)[0] for process in started)
    assert codes == [0] + [2] * (count - 1)
    environment = json.loads((folder / "same" / "environment.json").read_text())
    assert "resumed" not in environment


def test_of_two_runs_in_one_directory_one_is_refused(tmp_path):
    race(tmp_path / "a", RSSI, 2)
