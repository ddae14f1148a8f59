"""Nothing lost, nothing silently wrong: runs that are interrupted, resumed, started twice, or whose input changes."""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import quick
import torch
from PIL import Image
from quick import run, said

from swiftwrf import InputError, rssi_room
from swiftwrf.runtime import durable
from tasks import environment
from tasks.command import main
from tasks.directory import Claim
from tasks.records import Records, read_table, write_table
from tasks.report import merge
from tasks.rssi import experiment as rssi

TABLES = ("errors.csv", "predictions.csv")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The directory of a run."""
    folder = tmp_path_factory.mktemp("run") / "rssi"
    assert run("rssi", "--rx", "1", "--out", folder) == 0
    return folder


@pytest.fixture(scope="module")
def stopped_once(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stopped")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rssi, "finish", _interrupt)
        assert run("rssi", "--rx", "1", "--out", folder / "run") == 130
    return folder / "run.partial"


@pytest.fixture
def stopped(stopped_once, tmp_path):
    """An RSSI run that was interrupted after its steps."""
    return Path(shutil.copytree(stopped_once, tmp_path / "run.partial"))


def _interrupt(*_):
    raise KeyboardInterrupt


def _files(folder):
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_a_report_without_out_is_new_each_time(finished, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("first", "second"):
        monkeypatch.setattr("tasks.report.stamp", lambda name=name: name)
        assert run("report", finished) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "report: runs/report/second/report.html"


@pytest.mark.parametrize("damage", ["", "{", "[1]", '{"value": null}'])
def test_a_damaged_step_does_not_cost_the_others(stopped, capsys, damage):
    (stopped / "steps" / "mean.json").write_text(damage)
    before = _files(stopped)
    assert run("resume", stopped) == 2
    assert "mean.json" in said(capsys)
    assert {name for name, content in _files(stopped).items() if before.get(name) != content} <= {"environment.json"}


def test_a_run_stopped_while_it_finishes_states_how_to_finish_it(finished, tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        patch.setattr("tasks.directory.rename", _interrupt)
        assert run("rssi", "--rx", "1", "--quiet", "--out", tmp_path / "cut") == 130
    assert capsys.readouterr().err == f"stopped; continue with: swiftwrf resume {tmp_path / 'cut.partial'}\n"
    assert (tmp_path / "cut.partial" / "metrics.json").exists()
    assert run("resume", tmp_path / "cut.partial", "--json") == 0
    assert json.loads(capsys.readouterr().out)["rows"]
    assert sorted(p.name for p in (tmp_path / "cut").iterdir()) == sorted(p.name for p in finished.iterdir())
    for name in TABLES:
        assert (tmp_path / "cut" / name).read_bytes() == (finished / name).read_bytes()


@pytest.mark.long
def test_a_killed_run_goes_on_to_the_same_tables(finished, tmp_path):
    run_task = [sys.executable, Path(quick.__file__), "rssi", "--rx", "1", "--out", tmp_path / "cut"]
    process = subprocess.Popen(run_task, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
    while not (tmp_path / "cut.partial" / "steps" / "mean.json").exists():
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert run("resume", tmp_path / "cut.partial") == 0
    assert not (tmp_path / "cut" / "steps").exists()
    for name in TABLES:
        assert (tmp_path / "cut" / name).read_bytes() == (finished / name).read_bytes()


def test_a_failed_start_leaves_nothing(tmp_path, monkeypatch):
    def refuse(*_, **options):
        raise InputError("no")

    monkeypatch.setattr(rssi, "compare", refuse)
    assert run("rssi", "--rx", "1", "--out", tmp_path / "run") == 2
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("file", "keys", "value", "says"),
    [
        ("config.json", ("config", "seed"), 1, "not what the run began with"),
        ("environment.json", ("packages", "torch"), "0.1", "began (torch 0.1); restore it"),
        ("environment.json", ("packages", "swiftwrf-tasks"), "0.0.1", "began (swiftwrf-tasks 0.0.1); restore it"),
        ("environment.json", ("commit",), "0123456789ab", "began (commit 0123456789ab); restore it"),
        ("environment.json", ("packages",), 3, ", torch, torchvision"),
    ],
)
def test_resume_refuses_another_configuration_and_other_versions(stopped, capsys, file, keys, value, says):
    """A library or this project in another version computes other numbers."""
    content = json.loads((stopped / file).read_text())
    place = content if len(keys) == 1 else content[keys[0]]
    place[keys[-1]] = value
    (stopped / file).write_text(json.dumps(content))
    assert run("resume", stopped) == 2
    assert says in said(capsys)
    assert (stopped / "steps" / "mean.json").exists()


def test_resume_refuses_changed_data(tmp_path, monkeypatch, capsys):
    """Every file that is read counts: here a floor plan."""
    plan = tmp_path / "plan.png"
    Image.new("RGB", (4, 4)).save(plan)
    with monkeypatch.context() as patch:
        patch.setattr(rssi, "finish", _interrupt)
        floor = ("--floor-plan", plan, "--floor-extent", 0, 1, 0, 1)
        assert run("rssi", "--rx", "1", *floor, "--out", tmp_path / "run") == 130
    Image.new("RGB", (5, 4)).save(plan)
    assert run("resume", tmp_path / "run.partial") == 2
    assert "changed since" in said(capsys)
    assert (tmp_path / "run.partial" / "steps" / "mean.json").exists()


def test_a_resumed_run_keeps_its_number_of_threads_and_its_report_says_where_it_went_on(stopped):
    file = stopped / "environment.json"
    content, before = json.loads(file.read_text()), torch.get_num_threads()
    file.write_text(json.dumps(content | {"threads": before + 1, "device": "an abacus"}))
    try:
        with quick.quick():
            assert main(["resume", str(stopped)]) == 0
        assert torch.get_num_threads() == before + 1
    finally:
        torch.set_num_threads(before)
    report = (stopped.with_name("run") / "report.html").read_text()
    assert "like the seed" in report
    assert "resumed" in report
    assert f", {content['device']}, processes: 1)" in report


@pytest.mark.parametrize("left", [[], ["environment.json"], ["steps/"]])
def test_a_directory_left_before_the_run_began_is_taken_over(tmp_path, capsys, left):
    partial = tmp_path / "run.partial"
    partial.mkdir()
    for name in left:
        (partial / name).mkdir() if name.endswith("/") else (partial / name).write_text("{}")
    assert run("resume", partial) == 2
    assert "start the run again" in said(capsys)
    assert run("rssi", "--rx", "1", "--out", tmp_path / "run") == 0


def test_foreign_files_are_never_taken_over(tmp_path, capsys):
    (tmp_path / "run.partial").mkdir()
    (tmp_path / "run.partial" / "thesis.txt").write_text("years of work")
    assert run("rssi", "--rx", "1", "--out", tmp_path / "run") == 2
    assert "exists already" in said(capsys)
    assert [file.name for file in (tmp_path / "run.partial").iterdir()] == ["thesis.txt"]


def test_one_process_at_a_time(stopped, tmp_path, capsys):
    claim = Claim(stopped, new=False)
    assert run("resume", stopped) == 2
    assert "another process" in said(capsys)
    claim.release()
    new = Claim(tmp_path / "new.partial", new=True)
    with pytest.raises(InputError, match="another process"):
        Claim(tmp_path / "new.partial", new=True)
    (tmp_path / "new.partial" / "config.json").write_text("{}")  # a run that has begun, too
    with pytest.raises(InputError, match="another process is at work"):
        Claim(tmp_path / "new.partial", new=True)
    new.release()
    with pytest.raises(InputError, match="go on with swiftwrf resume"):
        Claim(tmp_path / "new.partial", new=True)


def test_report_leaves_the_interrupted_work_of_others(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "one")
    (tmp_path / "long.partial").mkdir()
    (tmp_path / "long.partial" / "config.json").write_text("{}")
    merge([tmp_path / "one"], tmp_path / "long")
    assert (tmp_path / "long.partial" / "config.json").exists()
    assert {file.name for file in tmp_path.iterdir()} == {"one", "long", "long.partial"}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("metrics.json", "{"),
        ("metrics.json", "[]"),
        ("metrics.json", '{"task": "rssi"}'),
        ("metrics.json", '{"task": "other"}'),
        ("metrics.json", "\udcff"),
        ("config.json", "{}"),
        ("environment.json", '{"packages": 3}'),
        ("errors.csv", ""),
        ("errors.csv", "method\nswiftwrf\n"),
        ("errors.csv", None),
        ("maps.npz", "PK"),
    ],
)
def test_report_refuses_damaged_records(finished, tmp_path, capsys, name, content):
    shutil.copytree(finished, tmp_path / "run")
    file = tmp_path / "run" / name
    file.unlink()
    if content is not None:
        file.write_bytes(content.encode(errors="surrogateescape"))
    capsys.readouterr()
    assert run("report", tmp_path / "run", "--out", tmp_path / "report") == 2
    said(capsys)
    assert [file.name for file in tmp_path.iterdir()] == ["run"]


def test_names_are_text_and_no_formulas(tmp_path):
    names = ["NA", "nan", "1", "12:34:56", "", "=1+1", "+a", "-b", "@c", "'=d", "'e", "true"]
    write_table(tmp_path / "t.csv", [{"receiver": name, "value": float("nan"), "n": 1} for name in names])
    table = read_table(tmp_path / "t.csv")
    assert table["receiver"].fillna("").tolist() == names
    assert table["value"].isna().all()
    assert (table["n"] == 1).all()
    lines = (tmp_path / "t.csv").read_text().splitlines()
    assert not [line for line in lines if line[0] in "=+-@"]


def test_whole_numbers_stay_whole_where_other_rows_have_none(tmp_path):
    write_table(tmp_path / "t.csv", [{"step": 1}, {"step": None, "loss": 0.5}])
    assert (tmp_path / "t.csv").read_text().splitlines() == ["step,loss", "1,", ",0.5"]


def test_the_commit_is_that_of_this_project_and_names_every_change(tmp_path, monkeypatch):
    """Not that of a user's repository in which the package is installed."""
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c"]
    own = tmp_path / "tasks" / "environment.py"
    own.parent.mkdir()
    own.write_text("")
    subprocess.run([*git, "init", "--quiet"], check=True)
    subprocess.run([*git, "commit", "--quiet", "--allow-empty", "--message", "empty"], check=True)
    monkeypatch.setattr(environment, "__file__", str(own))
    assert environment._commit() is None
    subprocess.run([*git, "add", "."], check=True)
    subprocess.run([*git, "commit", "--quiet", "--message", "code"], check=True)
    clean = environment._commit()
    assert re.fullmatch("[0-9a-f]{12}", clean)
    (tmp_path / "notes.md").write_text("no code")
    assert environment._commit() == clean
    found = set()
    for name, content in (("environment.py", "1"), ("environment.py", "2"), ("new.py", "1"), ("new.py", "2")):
        own.with_name(name).write_text(content)
        found.add(environment._commit())
    assert len(found) == 4
    assert all(re.fullmatch(f"{clean}-dirty-[0-9a-f]{{12}}", text) for text in found)


@pytest.mark.filterwarnings("error:constrained_layout")
def test_a_receiver_may_have_any_name(tmp_path, monkeypatch):
    floor, names = rssi_room(n=40), ("NA", "$x^{$", "=cmd()", "12:34:56", "7", "<b>", "x" * 300)
    with quick.quick(drawn=True):
        renamed = replace(floor, receiver_names=(*names, *floor.receiver_names[len(names) :]))
        monkeypatch.setattr(rssi, "rssi_room", lambda seed: renamed)
        config = rssi.RssiTaskConfig(receivers=names, out=str(tmp_path / "run"))
        rssi.run(config)
    written = pd.read_csv(tmp_path / "run" / "errors.csv", dtype=str, keep_default_na=False)["receiver"]
    assert {name.removeprefix("'") for name in written} == set(names)
    assert "=cmd()" not in set(written)
    assert set(Records(tmp_path / "run").table("errors")["receiver"]) == set(names)


def test_files_reach_the_disk_before_they_get_their_name(tmp_path, monkeypatch):
    done: list[tuple[str, str]] = []
    fsync, rename = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda fd: (done.append(("sync", os.readlink(f"/proc/self/fd/{fd}"))), fsync(fd)))
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append(("rename", str(b))), rename(a, b)))
    durable.write_text(tmp_path / "a", "text")
    assert [kind for kind, _ in done] == ["sync", "rename", "sync"]
    assert done[0][1] != str(tmp_path / "a")
    assert done[2][1] == str(tmp_path)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    with durable.replacing(tmp_path / "a") as one, durable.replacing(tmp_path / "a") as other:  # threads of a process
        one.write_text("one")
        other.write_text("other")
    assert [file.read_text() for file in tmp_path.iterdir()] == ["one"]
    durable.write_text(tmp_path / "a", "old")
    with pytest.raises(UnicodeEncodeError):
        durable.write_text(tmp_path / "a", "\udcff")
    with suppress(OSError), durable.replacing(tmp_path / "a") as file:
        file.write_text("half")
        raise OSError("disk full")
    assert _files(tmp_path) == {"a": b"old"}


def test_a_full_disk_ends_in_a_sentence_and_can_be_resumed(tmp_path, capsys, monkeypatch):
    write, calls = durable.os.fsync, []

    def full(descriptor):
        calls.append(1)
        if len(calls) > 12:
            raise OSError(28, "No space left on device", "file")
        write(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(durable.os, "fsync", full)
        assert run("rssi", "--rx", "1", "--out", tmp_path / "run") == 2
    assert "no space left" in said(capsys)
    assert run("resume", tmp_path / "run.partial") == 0
    assert not list((tmp_path / "run").rglob(".*"))


@pytest.mark.parametrize(
    ("task", "error"), [("rssi", None), ("aoa", "great_circle_deg"), ("locate", "position_error_m")]
)
def test_merged_reports_show_every_run(request, tmp_path, task, error):
    run, other = request.getfixturevalue(f"{task}_run"), request.getfixturevalue("finished")  # of few rows
    if error:
        other = Path(shutil.copytree(run, tmp_path / "other"))
        table = pd.read_csv(other / "errors.csv")
        table.assign(**{error: 2 * table[error]}).to_csv(other / "errors.csv", index=False)
    with quick.sketched():
        merge([run, other], tmp_path / "both")
    drawn = _files(tmp_path / "both" / "figures")
    first, second = (
        {text for name, text in drawn.items() if run in name and name.startswith("errors") and name.endswith(".csv")}
        for run in ("run1", "run2")
    )
    assert first
    assert second
    assert not first & second
