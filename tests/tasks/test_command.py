"""The console script: its sub-commands, its speed, where it may be started, and command lines that cannot be."""

import gc
import os
import re
import resource
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from quick import run, said

from tasks.command import COMMANDS, main
from tasks.command_line import BROKEN_PIPE

ROOT = Path(__file__).parents[2]


def started(folder: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run the console script as pip installs it, in a directory of its own."""
    script = folder / "bin" / "swiftwrf"
    script.parent.mkdir(exist_ok=True)
    script.write_text("import sys\nfrom tasks.command import main\nsys.exit(main())\n")
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | variables
    return subprocess.run(
        [sys.executable, str(script), *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_help_lists_every_command_at_once(tmp_path):
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = started(tmp_path, "--help")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 1.5  # whatever runs beside
    assert done.returncode == 0
    listed = re.findall(r"^  (\w+) +\S", done.stdout, flags=re.MULTILINE)
    assert listed == [*COMMANDS]


def test_garbage_is_collected_while_and_after_a_command_runs(monkeypatch):
    collected = []
    monkeypatch.setattr("tasks.inspect.run", lambda config: collected.append(gc.isenabled()))
    assert main(["inspect", "room"]) == 0
    assert collected == [True]
    assert gc.isenabled()


@pytest.mark.parametrize("arguments", [("--help",), ("inspect", "--help")])
def test_a_closed_output_ends_a_command_without_a_message(arguments):
    """A case is `swiftwrf --help | head -1`, where `head` ends first."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tasks", *arguments], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.close()
    assert (process.stderr.read(), process.wait()) == (b"", BROKEN_PIPE)


@pytest.mark.parametrize("name", ["aoa", "rssi"])
def test_the_two_tasks_of_the_paper_are_packages_that_python_runs(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["main", "--help"])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_module(f"tasks.{name}", run_name="__main__")
    assert capsys.readouterr().out.startswith(f"usage: python -m tasks.{name} ")


def test_a_file_called_tasks_in_the_working_directory(tmp_path):
    """A common name: invoke and celery use it."""
    (tmp_path / "tasks.py").write_text("raise SystemExit('the wrong module')")
    done = started(tmp_path, "rssi", "--rx", "")
    assert done.returncode == 2
    assert done.stderr == "error: --rx is empty; give it a value or leave it out\n"


@pytest.mark.parametrize(
    ("given", "spins"), [({}, "30000"), ({"GOMP_SPINCOUNT": "5"}, "5"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "None")]
)
def test_commands_shorten_the_wait_of_threads_and_libraries_do_not(given, spins):
    """libgomp reads the variable when torch is loaded."""
    code = (
        "import os, sys, tasks, swiftwrf.errors\n"
        "show = lambda: print(os.environ.get('GOMP_SPINCOUNT'))\n"
        "show()\n"
        "class Stop:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'torch': show(); sys.exit()\n"
        "for name in [name for name in sys.modules if name.startswith(('torch', 'swiftwrf'))]: del sys.modules[name]\n"
        "sys.meta_path.insert(0, Stop())\n"
        "from tasks.command import main\n"
        "main(['rssi', '--rx', '1'])\n"
    )
    own = {key: value for key, value in os.environ.items() if key not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    done = subprocess.run([sys.executable, "-c", code], env=own | given, stdout=subprocess.PIPE, text=True, check=True)
    assert done.stdout.split() == [given.get("GOMP_SPINCOUNT", "None"), spins]


def test_unknown_commands_and_directories(tmp_path, capsys):
    assert main(["rsi"]) == 2
    assert "unknown command 'rsi'; choose from aoa, rssi" in said(capsys)
    assert main(["resume", str(tmp_path)]) == 2
    assert "no interrupted run" in said(capsys)
    (tmp_path / "old.partial").mkdir()
    (tmp_path / "old.partial" / "config.json").write_text('{"task": "other"}')
    assert main(["resume", str(tmp_path / "old.partial")]) == 2
    assert "unknown task 'other'" in said(capsys)


# command lines that cannot be: each ends in one sentence and exit code 2, and leaves nothing


@pytest.mark.parametrize(
    ("task", "arguments", "says"),
    [
        ("aoa", ("--mix", 0.5, "--data", ""), "--data is empty"),
        ("rssi", ("--rx", "1", "--data", ""), "--data is empty"),
        ("rssi", ("--rx", ""), "--rx is empty"),
        ("aoa", ("--mix", 0.5, "--seed", -1), "--seed must be"),
        ("aoa", ("--mix", 0.5, "--seed", 2**32), "--seed must be"),
        ("rssi", ("--rx", "1", "--seed", -1), "--seed must be"),
        ("aoa", ("--mix", 0.5, "--seed", 2**32 - 1, "--repeats", 2), "--seed"),
        ("aoa", ("--mix", 0.5, "--synthesizer"), "--synthesizer"),
        ("aoa", ("--mix", 0.5, "--array", 4, 0.16, "nan"), "finite"),
        ("aoa", ("--mix", 0.5, "--array", 100000, 0.16, 1e9), "--array"),
        ("aoa", ("--mix", "nan"), "finite"),
        ("aoa", ("--seed", 1), "got none"),
        ("aoa", ("--mix", 0), "in (0, 1]"),
        ("aoa", ("--mix", 0.3, 0.3), "twice"),
        ("aoa", ("--mix", 0.5, "--repeats", 0), "--repeats"),
        ("aoa", ("--mix", 0.5, "--suggest", -1), "--suggest"),
        ("aoa", ("--mix", 0.5, "--data", "/nowhere"), "is not a folder"),
        ("rssi", ("--rx", "99"), "no receiver '99'"),
        ("rssi", ("--rx", "1", "--floor-plan", "x.png"), "needs --floor-extent"),
        ("rssi", ("--rx", "1", "--floor-plan", "x.png", "--floor-extent", 0, 1, 0, 1), "not a readable image"),
        ("rssi", ("--rx", "1", "--floor-plan", "x.png", "--floor-extent", 1, 0, 0, 1), "x0 < x1"),
        ("aoa", ("--mix", 1e-9), "leaves 0"),
        ("rssi", ("--rx", "1", "--floor-extent", 0, "inf", 0, "inf"), "finite"),
        ("rssi", ("--rx", "1", "--out", "{file}/run"), "cannot read or write"),
        ("rssi", ("--rx", "1", "--out", "/proc/run"), "cannot read or write"),
        ("rssi", ("--rx", "1", "--out", "/"), "no name of its own"),
        ("rssi", ("--rx", "1", "--out", "."), "no name of its own"),
        ("rssi", ("--rx", "1", "--out", "{file}-" + "x" * 300), "cannot read or write"),
        ("resume", ("{file}",), "no interrupted run"),
        ("locate", ("--data", ""), "--data is empty"),
        ("locate", ("--rx", "99"), "no receiver '99'"),
        ("locate", ("--split", "nowhere"), "choose one of block, random"),
        ("rssi", ("--rx", "1", "--split", "nowhere"), "choose one of block, random"),
        ("locate", ("--cells", 9), "--cells must be a whole number at least 10"),
        ("aoa", ("--mix", 0.5, "--processes", 0), "--processes must be a whole number at least 1, got 0"),
        ("rssi", ("--rx", "1", "--out", "link"), "link exists already"),
        ("report", ("{file}", "--out", "link"), "no finished run"),
        ("predict", ("{file}", "{file}", "--out", "link"), "link exists already"),
        ("locate", ("--columns", "x=a"), "give it with --data"),
        ("locate", ("--data", "x", "--offset-by", "=phone"), "takes COLUMN or COLUMN=VALUE"),
        ("locate", ("--scheduler", "tcp://127.0.0.1:1"), "no Dask scheduler"),
        ("predict", ("{file}", "{file}", "--out", "{file}-new.csv"), "not a readable safetensors file"),
        ("report", ("{file}",), "no finished run"),
        ("report", ("--out", "{file}/x"), "no runs"),
        ("inspect", ("/nowhere", "--out", "page"), "is not a folder or file"),
    ],
)
def test_command_lines_end_in_a_sentence(tmp_path, capsys, monkeypatch, task, arguments, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    (tmp_path / "link").symlink_to("nowhere")
    assert run(task, *(str(a).replace("{file}", str(tmp_path / "file")) for a in arguments)) == 2
    assert says in said(capsys)
    assert {file.name for file in tmp_path.iterdir()} == {"file", "link"}


def test_sixty_shares_without_out(tmp_path, monkeypatch):
    from tasks.configs import RssiTaskConfig
    from tasks.directory import Run

    monkeypatch.chdir(tmp_path)
    label = "mix" + "_".join(f"0.{i}" for i in range(60)) + "/../" + "\u00e4" * 200
    with Run("rssi", label, RssiTaskConfig(("1",)), torch.device("cpu"), {}) as directory:
        name = directory.final.name
    assert len(name) < 100
    assert "/" not in name


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read and write everything")
def test_unreadable_data_are_told_from_unwritable_directories(tmp_path, capsys):
    (tmp_path / "data").mkdir(mode=0)
    assert run("rssi", "--rx", "1", "--data", tmp_path / "data") == 2
    assert "write" not in said(capsys)
