"""Output of commands: results while computing, the answer as a table or as JSON, the browser, and how to resume."""

import io
import json
import os
import re
import subprocess
import sys
import time
from html import unescape
from types import SimpleNamespace

import pandas as pd
import pytest
import quick
from rich.console import Console
from samples import write_survey

from swiftwrf.runtime.progress import progress
from tasks.command import run_command
from tasks.options import General
from tasks.terminal import Answer, Method, NextStep, Terminal, _Line, terminal

COLUMNS = {"dB": "abs_error_db", "m": "position_error_m"}
ERROR = {"median": 2.36, "p90": 7.0, "mean": 3.1, "low": 2.0, "high": 2.9, "n": 40}


def method(name, median, **options):
    return Method(name, ERROR | {"median": median}, **options)


@pytest.fixture
def found():
    methods = [method("peak", 9.0, is_reference=True), method("gp", 3.0), method("network, measured", 2.36)]
    return Answer("deg", methods, "gp", ["It works.", "It helps."], [NextStep("Look", "swiftwrf view 'a b'")])


def test_the_answer_is_the_conclusion_a_sorted_table_next_steps_and_the_report(tmp_path, capsys, found):
    Terminal().answer(found, tmp_path / "report.html")
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    first, second, empty, head, *rows, none, step, last = lines
    assert " ".join(head.split()) == "what you can use (* recommended) median [deg] 95 % interval 90 % below [deg]"
    assert rows[0].split() == ["network,", "measured", "2.36", "2.00", "to", "2.90", "7.00"]
    assert [row.split()[0] for row in rows] == ["network,", "*", "references", "peak"]
    assert (none, step, empty) == ("", "Look: swiftwrf view 'a b'", "")
    assert (first, second, last) == ("It works.", "It helps.", f"report: {tmp_path / 'report.html'}")


def test_the_short_table_has_seven_rows_with_the_chosen_the_best_and_those_asked_for():
    methods = [method(f"m{n}", float(n), is_reference=n > 7) for n in range(12)]
    usable, references = Answer("m", methods, "m6", [], [], ("m5", "m11")).short()
    assert [one.name for one in usable] == ["m0", "m1", "m2", "m5", "m6"]
    assert [one.name for one in references] == ["m8", "m11"]


def test_json_is_one_object_and_nothing_else(tmp_path, capsys, found):
    shown = Terminal()
    with shown.of(General(json=True)):
        shown.console.print("a note")
        with shown.progress():
            shown.begin("gp", "gp")
            shown.end("gp", "2 dB")
        shown.answer(found, tmp_path / "report.html")
    out, err = capsys.readouterr()
    content = json.loads(out)
    assert content["rows"][0]["median_deg"] == 2.36
    assert (content["conclusion"], content["report"]) == ("It works. It helps.", str(tmp_path / "report.html"))
    assert err == ""


def test_open_shows_the_report_in_the_browser(tmp_path, monkeypatch, found):
    opened = []
    monkeypatch.setattr("tasks.terminal.webbrowser.open", opened.append)
    shown = Terminal()
    with shown.of(General(open=True)):
        shown.answer(found, tmp_path / "report.html")
    assert opened == [(tmp_path / "report.html").as_uri()]


def test_one_display_has_the_fraction_of_all_steps():
    shown = Terminal()
    shown.console = Console(file=io.StringIO(), force_terminal=True, width=120)
    seen = []
    with shown.progress():
        shown.expect(2)
        for number, name in enumerate("ab", 1):
            shown.begin(name, "training")
            for _ in progress(range(4), "inner"):
                pass
            task = shown._progress.tasks[0]
            assert task.description == f"[{number}/2] training"
            seen.append(task.completed / task.total)
            shown.end(name)
            seen.append(task.completed / task.total)
    assert seen == [0.5, 0.5, 1.0, 1.0]
    assert "inner" not in shown.console.file.getvalue()


@pytest.mark.parametrize(("seconds", "words"), [(None, "fit"), (99, "fit, 99 s left"), (200, "fit, 3 min left")])
def test_the_time_left_is_in_seconds_or_minutes(seconds, words):
    assert str(_Line().render(SimpleNamespace(description="fit", time_remaining=seconds))) == words


def test_into_a_file_steps_have_a_line_at_their_start_and_their_end():
    shown = Terminal()
    shown.console = Console(file=io.StringIO(), width=20)
    with shown.progress():
        shown.expect(3)
        shown.begin("a", "network, all measured")
        shown.begin("b", "peak")
        shown.end("b", "2.36 degrees")
        shown.end("a")
    first, second, third, fourth = shown.console.file.getvalue().splitlines()
    assert (first, second) == ("[1/3] network, all measured", "[2/3] peak")
    assert third.startswith("[2/3] peak: 2.36 degrees, ")
    assert fourth.startswith("[1/3] network, all measured: ")


def test_into_a_file_a_line_is_printed_at_least_every_20_seconds():
    """Use a clock of the test: each step with its own seconds, and the whole command where no step is computed."""
    now = [100.0]
    shown = Terminal(lambda: now[0])
    shown.console = Console(file=io.StringIO(), width=20)

    def lines_after(seconds):
        before = len(shown.console.file.getvalue().splitlines())
        now[0] += seconds
        shown.remind()
        return shown.console.file.getvalue().splitlines()[before:]

    with shown.of(General(), endless=True):
        assert lines_after(19) == []
        assert lines_after(1) == ["working: 20 s"]
        with shown.progress():
            shown.expect(2)
            shown.begin("a", "finding the room")
            assert lines_after(19) == []
            shown.begin("b", "testing peak")
            assert lines_after(19) == []
            assert lines_after(1) == ["[1/2] finding the room: 39 s; [2/2] testing peak: 20 s"]
            assert lines_after(19) == []
            shown.end("a")
            assert lines_after(20) == ["[2/2] testing peak: 59 s"]
            shown.end("b")
        assert lines_after(20) == ["writing the results: 118 s"]
    with shown.of(General(quiet=True), endless=True):
        assert lines_after(100) == []


def test_a_command_reminds_by_itself_and_an_endless_one_is_silent(monkeypatch):
    monkeypatch.setattr("tasks.terminal.MAX_SILENCE_S", 0.02)
    for endless in (True, False):
        shown = Terminal()
        shown.console = Console(file=io.StringIO(), width=20)
        ends = time.perf_counter() + (0.2 if endless else 30)
        with shown.of(General(), endless):
            while not shown.console.file.getvalue() and time.perf_counter() < ends:
                time.sleep(0.01)
        printed = len(shown.console.file.getvalue())
        assert bool(printed) is not endless
    time.sleep(0.2)
    assert len(shown.console.file.getvalue()) == printed, "it goes on after the end of the command"


@pytest.mark.parametrize(
    ("run", "answered", "unit"),
    [
        ("rssi_run", "above -75 dBm", "dB"),
        ("locate_run", "Positions are found within", "m"),
        ("aoa_run", "Directions are found within", "degrees"),
    ],
)
def test_a_run_shows_results_and_its_answer(request, run, answered, unit):
    folder = request.getfixturevalue(run)
    out, err = ((folder.parent / name).read_text() for name in ("out.txt", "err.txt"))
    conclusion, table, steps = out.split("\n\n")
    first, *_ = conclusion.splitlines()
    assert answered in first
    assert table.startswith("what you can use (* recommended)")
    assert steps.splitlines()[-1] == f"report: {folder / 'report.html'}"
    html = unescape(re.sub("<[^>]*>", "", (folder / "report.html").read_text()))
    assert first.removeprefix("50% measured: ").replace("`", "") in html
    shown = re.findall(
        rf"^\[\d+/\d+\] (?:.*testing|locating by) (.*): ([\d.]+) {unit}, [\d.]+ s$", err, flags=re.MULTILINE
    )
    found = pd.read_csv(folder / "errors.csv").groupby("method")
    assert len(shown) >= 4
    for name, text in shown if unit != "degrees" else ():
        assert float(text) == pytest.approx(found[COLUMNS[unit]].median()[name], abs=0.00501)
    assert not {*json.loads((folder / "config.json").read_text())["config"]} & {"open", "quiet", "json"}


def test_quiet_runs_show_the_answer_alone(tmp_path, capsys):
    assert quick.run("rssi", "--rx", "1", "--quiet", "--out", tmp_path / "run") == 0
    out, err = capsys.readouterr()
    assert "above -75 dBm" in out.splitlines()[0]
    assert err == ""
    assert not terminal.console.quiet


@pytest.mark.parametrize(
    ("stream", "options"), [("", ""), ("", "--json"), (">&-", ""), (">&- 2>&-", "--json")], ids=str
)
def test_no_stream_and_no_setting_of_a_session_ends_a_command(tmp_path, stream, options):
    """Neither an encoding without the characters of a file, nor a closed stream, nor a name of windows of matplotlib."""
    write_survey(tmp_path, "caf\u00e9.csv")
    environment = {"PYTHONIOENCODING": "ascii", "MPLBACKEND": "nope", "PYTHONPATH": os.pathsep.join(sys.path)}
    command = f"{sys.executable} -m tasks inspect caf\u00e9.csv --out out {options} {stream}"
    done = subprocess.run(
        command, cwd=tmp_path, env=os.environ | environment, shell=True, capture_output=True, check=False
    )
    assert (done.returncode, done.stderr.count(b"Traceback")) == (0, 0), done.stderr[-500:]
    assert (tmp_path / "out" / "report.html").exists()
    if stream == "":
        out = done.stdout.decode("ascii")
        assert json.loads(out)["source"] == "caf\u00e9.csv" if options else out.startswith("caf\\xe9.csv: RSSI")


def test_a_library_that_cannot_be_loaded_is_one_sentence(monkeypatch, capsys):
    def broken(*_):
        raise ImportError("libtorch.so: failed to map segment from shared object")

    monkeypatch.setattr("tasks.command.run_task", broken)
    assert run_command("inspect", ["x", "--out", "y"], "swiftwrf inspect") == 2
    assert capsys.readouterr().err.startswith("error: a library cannot be loaded (libtorch.so: failed to map")
