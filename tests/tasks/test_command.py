"""The console script: its sub-commands, its speed, where it may be started, and command lines that cannot be."""

import gc
import os
import re
import resource
import runpy
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro
from fuzz.kinds import fitted
from quick import run, said
from samples import write_snapshots, write_survey

from swiftwrf import AngularGrid, simulated_room
from swiftwrf.data.writing import write_spectra
from tasks import configs
from tasks.command import COMMANDS, main
from tasks.command_line import BROKEN_PIPE, STYLE

ROOT = Path(__file__).parents[2]


def started(folder: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run the console script as pip installs it, in a directory of its own."""
    script = folder / "bin" / "swiftwrf"
    script.parent.mkdir(exist_ok=True)
    script.write_text("import sys\nfrom tasks.command import main\nsys.exit(main())\n")
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | variables
    command = [sys.executable, str(script), *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


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
    command, pipe = [sys.executable, "-m", "tasks", *arguments], subprocess.PIPE
    process = subprocess.Popen(command, cwd=ROOT, stdout=pipe, stderr=pipe)
    process.stdout.close()
    assert (process.stderr.read(), process.wait()) == (b"", BROKEN_PIPE)


@pytest.mark.parametrize("name", COMMANDS)
def test_python_runs_the_module_of_each_command(name, monkeypatch, capsys):
    if not (ROOT / "tasks" / name).is_dir():
        monkeypatch.delitem(sys.modules, f"tasks.{name}", raising=False)  # which python -m has not imported either
    monkeypatch.setattr(sys, "argv", ["main", "--help"])
    with pytest.raises(SystemExit, match="0"):
        runpy.run_module(f"tasks.{name}", run_name="__main__")
    assert capsys.readouterr().out.startswith(f"usage: python -m tasks.{name} ")


def test_a_file_called_tasks_in_the_working_directory(tmp_path):
    """A common name: invoke and celery use it."""
    (tmp_path / "tasks.py").write_text("raise SystemExit('the wrong module')")
    done = started(tmp_path, "rssi", "--rx", "")
    assert done.returncode == 2
    assert done.stderr == "error: --receivers is empty; give it a value or leave it out\n"


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


def test_an_unknown_command_is_refused_with_those_that_exist(capsys):
    assert main(["rsi"]) == 2
    assert "unknown command 'rsi'; did you mean rssi?" in said(capsys)
    assert main(["x"]) == 2
    assert "unknown command 'x'; choose from aoa, rssi" in said(capsys)


def test_version_and_help_as_words(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"swiftwrf {version('swiftwrf-tasks')}\n"
    assert main(["help"]) == 0
    assert capsys.readouterr().out.startswith("usage: swiftwrf COMMAND")
    for words in (["help", "rssi"], ["--help", "rssi"], ["-h", "rssi"]):
        with pytest.raises(SystemExit, match="0"):
            main(words)
        assert capsys.readouterr().out.startswith("usage: swiftwrf rssi ")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_has_every_command_and_option(capsys, shell):
    assert main(["completion", shell]) == 0
    text = capsys.readouterr().out
    for name, command in COMMANDS.items():
        offered = re.search(rf'^ +{name}\) words="(.*)"', text, flags=re.MULTILINE)
        words = offered[1].split() if offered else [f"--{word}" for word in re.findall(rf"from {name}' -l (.*)", text)]
        parser = tyro.extras.get_parser(
            getattr(configs, command.options), config=(*STYLE, tyro.conf.FlagCreatePairsOff)
        )
        taken = {word for action in parser._actions for word in action.option_strings if word.startswith("--")}
        assert set(words) == taken - {"--help"} | {"--config", "--verbose", "--quiet", "--json", "--open"}, name
    assert main(["completion", "tcsh"]) == 2
    assert "completion is for bash, zsh, fish, got 'tcsh'" in said(capsys)


def test_bash_completes():
    """The shell itself is asked."""
    words = (
        'eval "$(python -m tasks completion bash)"; COMP_WORDS=({}); COMP_CWORD={}; _swiftwrf; echo "${{COMPREPLY[@]}}"'
    )
    for line, number, found in (
        ("swiftwrf locate --fl", 2, "--floor-plan --floor-extent"),
        ("swiftwrf r", 1, "rssi report resume"),
    ):
        done = subprocess.run(["bash", "-c", words.format(line, number)], capture_output=True, text=True, check=True)
        assert done.stdout.strip() == found


@pytest.mark.parametrize("task", ["aoa", "rssi", "locate"])
def test_a_source_that_comes_first_is_the_data(monkeypatch, task):
    seen = []
    monkeypatch.setattr(f"tasks.{task}.experiment.run", seen.append)
    mix = ("--mix", "0.3") if task == "aoa" else ()
    assert main([task, "walk.csv", *mix]) == 0
    assert main([task, *mix, "--data", "walk.csv"]) == 0
    assert seen[0] == seen[1]
    assert seen[0].data == "walk.csv"
    if task == "rssi":
        assert seen[0].receivers == ("all",)


# command lines that cannot be: each ends in one sentence and exit code 2, and leaves nothing


COARRAY = ("--mix", 0.5, "--synthesizer", "coarray")
FOLLOWED = ("m", "table.csv", "--out", "x", "--follow")
without_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
LINES = [
    ("aoa", ("--mix", 0.5, "--data", ""), "--data is empty"),
    ("rssi", ("--rx", "1", "--data", ""), "--data is empty"),
    ("rssi", ("--rx", ""), "--receivers is empty"),
    ("aoa", ("--mix", 0.5, "--seed", -1), "--seed must be"),
    ("aoa", ("--mix", 0.5, "--seed", 2**32), "--seed must be"),
    ("rssi", ("--rx", "1", "--seed", -1), "--seed must be"),
    ("aoa", ("--mix", 0.5, "--seed", 2**32 - 1, "--repeats", 2), "--seed"),
    ("aoa", ("--mix", 0.5, "--synthesizer"), "--models"),
    ("inspect", ("x", "--array", 4, 0.16, "nan"), "finite"),
    ("inspect", ("x", "--array", 100000, 0.16, 1e9), "--array"),
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
    ("locate", ("--columns", "x=a"), "--columns is no option of this command; give --columns to swiftwrf inspect"),
    ("rssi", ("--rx", 1, "--read", "x.yaml"), "--read states how --data is read; give both"),
    ("rssi", ("--rx", 1, "--data", "{survey}", "--read", "x.yaml"), "--read x.yaml cannot be read"),
    ("inspect", ("x", "--offset-by", "=phone"), "takes COLUMN or COLUMN=VALUE"),
    ("inspect", ("{survey}", "--every", 2, "--read", "x.yaml"), "exclude each other"),
    ("predict", ("{file}", "{file}", "--open"), "writes no report"),
    ("locate", ("--scheduler", "tcp://127.0.0.1:1"), "no Dask scheduler"),
    ("predict", ("{file}", "{file}", "--out", "{file}-new.csv"), "not a readable safetensors file"),
    ("report", ("{file}",), "no finished run"),
    ("report", ("--out", "{file}/x"), "no runs"),
    ("inspect", ("/nowhere", "--out", "page"), "is not a folder or file"),
    ("aoa", ("--mix", 0.5, "--synthesizer", "nearest", "--scene", "office"), "--scene is for the model raytrace"),
    ("aoa", ("--mix", 0.5, "--synthesizer", "raytrace", "--scene", "kitchen"), "unknown room 'kitchen'"),
    ("aoa", ("--mix", 0.5, "--synthesizer", "raytrace", "--scene", "none.xml"), "--scene none.xml does not exist"),
    ("aoa", (*COARRAY, "--data", "{bare}"), "give it with --array; give --array to swiftwrf inspect"),
    ("aoa", (*COARRAY, "--data", "{bare}", "--read", "{one_element}"), "2 to 32 elements a side"),
    pytest.param("aoa", ("--mix", 0.5, "--device", "cuda"), "NVIDIA GPU", marks=without_gpu),
    ("locate", ("--suggest", 501), "--suggest must be a whole number at least 0 and at most 500"),
    ("resume", (".",), "no interrupted run"),
    ("resume", ("{other}",), "unknown task 'other'"),
    ("convert", ("{snapshots}", "{other}"), "never overwritten; choose another directory"),
    ("convert", ("/nowhere", "new"), "is not a folder or file"),
    ("convert", ("{snapshots}", "new", "--columns", "x"), "x=NAME"),
    ("convert", ("{snapshots}", "new", "--columns", "x=a"), "takes no columns"),
    ("convert", ("{snapshots}", "new", "--grid", 1, 1), "--grid"),
    ("convert", ("{snapshots}", "new", "--every", 0), "--every must be a whole number at least 1"),
    ("convert", ("{snapshots}", "new", "--array", 1, 0.06, 2.4e9), "2 to 32 elements a side"),
    ("convert", ("{snapshots}", "new", "--array", 2, 64, 0.06, 2.4e9), "2 to 32 elements a side"),
    ("convert", ("{snapshots}", "new", "--array", 2, 0, 0.06, 2.4e9), "2 to 32 elements a side"),
    ("convert", ("{snapshots}", "new", "--array", 2, 8, -0.06, 2.4e9), "above 0"),
    ("convert", ("{survey}", "new", "--calibrate"), "takes array snapshots"),
    ("convert", ("{snapshots}", "new", "--split", "block"), "are of the calibration; give --calibrate, too"),
    ("convert", ("{survey}", "new", "--beamformer", "capon"), "takes no beamformer"),
    ("convert", ("{snapshots}", "new", "--beamformer", "music"), "unknown beamformer"),
    ("convert", ("{snapshots}", "new", "--calibrate", "--split", "days"), "no split 'days'"),
    ("convert", ("{room}", "out.tif"), "holds a map of RSSI"),
    ("convert", ("{room}", "out.csv", "--cell", 1), "are for maps of RSSI models"),
    ("convert", ("{room}", "out.mat", "--deepmimo"), "give a directory"),
    ("convert", ("{room}", "out.mat", "--calibrate"), "writes a directory"),
    ("convert", ("{room}", "out.png", "--cell", 0), "a number above 0"),
    ("convert", ("{room}", "nowhere/out.csv"), "no directory"),
    ("convert", ("{rssi_model}", "out"), "is a model"),
    ("convert", ("{field_model}", "out.csv"), "use swiftwrf predict"),
    ("convert", ("{rssi_model}", "a.tif", "--rx", "nobody"), "no receiver 'nobody'"),
    ("convert", ("{rssi_model}", "map.geojson"), "needs latitude and longitude"),
    ("predict", ("none", "{spectra}", "--out", "out.csv"), "not a readable"),
    ("predict", ("{estimator}", "none.npy", "--out", "out.csv"), "is missing"),
    ("predict", ("{estimator}", "{spectra}", "--out", "{file}"), "exists already"),
    ("predict", ("{estimator}", "{spectra}", "--out", "no/out.csv"), "no directory"),
    ("predict", ("{estimator}", "{spectra}", "--read", "{seventh}", "--out", "out.csv"), "every does not apply"),
    (
        "predict",
        ("{field_model}", "{survey}", "--read", "{seventh}", "--out", "b.csv"),
        "yaml states every, which does not apply to positions",
    ),
    ("predict", ("{field_model}", "{survey}", "--track", 1, "--out", "b.csv"), "locates nothing"),
    ("update", ("m", "table.csv", "--out", "x", "--follow", "--json"), "--follow prints JSON lines"),
    ("update", ("m", "table.csv", "--out", "x", "--false-alarm-rate", 2), "--false-alarm-rate must be"),
    ("update", ("m", "table.csv", "--out", "x", "--follow", "--open"), "--follow prints JSON lines"),
    ("update", (*FOLLOWED, "--read", "{seventh}"), "every is no option of reading a followed source"),
]


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """Paths by name: an empty file, measurements, models and an interrupted run of something else."""
    folder = tmp_path_factory.mktemp("sources")
    place = {name: folder / name for name in ("file", "snapshots", "room", "bare")}
    place |= {"spectra": folder / "spectra.npy", "other": folder / "other.partial"}
    place["file"].touch()
    for name, text in (("seventh", "every: 7"), ("one_element", "array: [1, 0.16, 915e6]")):
        place[name] = folder / f"{name}.yaml"
        place[name].write_text(text)
    write_snapshots(place["snapshots"])
    place["survey"] = write_survey(folder / "survey")
    room = simulated_room(n=20, grid=AngularGrid.hemisphere(8, 32))
    for name, data in (("room", room), ("bare", replace(room, array=None))):
        place[name].mkdir()
        write_spectra(data, place[name])
    models = {"rssi_model": "rssi model", "field_model": "inverse-distance model", "estimator": "kernel regression"}
    for name, kind in models.items():
        place[name] = folder / f"{name}.safetensors"
        fitted(kind).save(place[name])
    np.save(place["spectra"], room.spectrum.numpy())
    place["other"].mkdir()
    (place["other"] / "config.json").write_text('{"task": "other"}')
    return place


@pytest.mark.parametrize(("task", "arguments", "says"), LINES)
def test_command_lines_end_in_a_sentence(sources, tmp_path, capsys, monkeypatch, task, arguments, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to("nowhere")
    before = sorted(sources["file"].parent.rglob("*"))
    assert run(task, *(str(a).format(**sources) for a in arguments)) == 2
    assert says in said(capsys)
    assert [file.name for file in tmp_path.iterdir()] == ["link"]
    assert sorted(sources["file"].parent.rglob("*")) == before


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
