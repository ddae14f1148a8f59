"""Output of commands: results while computing, the answer as a table or as JSON, the browser, and how to resume."""

from __future__ import annotations

import io
import json

import pytest
import quick
from rich.console import Console

from swiftwrf.runtime.progress import progress
from tasks.options import Output
from tasks.terminal import Answer, Terminal, terminal

ERROR = {"median": 2.36, "p90": 7.0, "mean": 3.1, "low": 2.0, "high": 2.9, "n": 40}


@pytest.fixture
def found():
    return Answer("deg", [({"condition": "measured alone"}, ERROR)], "It helps.", ["Measure more."])


def test_the_answer_is_a_table_a_conclusion_next_steps_and_the_report(tmp_path, capsys, found):
    Terminal().answer(found, tmp_path / "report.html")
    head, row, *rest = capsys.readouterr().out.splitlines()
    assert " ".join(head.split()) == "condition median [deg] 95 % interval mean [deg] 90 % below [deg]"
    assert row.split() == ["measured", "alone", "2.36", "2.00", "to", "2.90", "3.10", "7.00"]
    assert rest == ["", "It helps.", "- Measure more.", f"report: {tmp_path / 'report.html'}"]


def test_json_is_one_object_and_nothing_else(tmp_path, capsys, found):
    shown = Terminal()
    with shown.of(Output(json=True)):
        shown.console.print("a note")
        shown.result("gp", "2 dB")
        shown.answer(found, tmp_path / "report.html")
    out, err = capsys.readouterr()
    content = json.loads(out)
    assert content["rows"][0]["median_deg"] == 2.36
    assert (content["conclusion"], content["report"]) == ("It helps.", str(tmp_path / "report.html"))
    assert err == ""


def test_open_shows_the_report_in_the_browser(tmp_path, monkeypatch, found):
    opened = []
    monkeypatch.setattr("tasks.terminal.webbrowser.open", opened.append)
    shown = Terminal()
    with shown.of(Output(open=True)):
        shown.answer(found, tmp_path / "report.html")
    assert opened == [(tmp_path / "report.html").as_uri()]


def test_one_display_has_the_fraction_of_all_steps():
    shown = Terminal()
    shown.console = Console(file=io.StringIO(), force_terminal=True, width=120)
    seen = []
    with shown.progress():
        shown.expect(2)
        for _ in range(2):
            shown.begin("training")
            for _ in progress(range(4), "inner"):
                pass
            task = shown._progress.tasks[0]
            seen.append(task.completed / task.total)
            shown.end()
            seen.append(task.completed / task.total)
    assert seen == [0.5, 0.5, 1.0, 1.0]
    assert "inner" not in shown.console.file.getvalue()


@pytest.mark.parametrize(
    ("run", "first", "unit"),
    [("rssi_run", "model", "dB"), ("locate_run", "localizer", "m"), ("aoa_run", "measured", "deg")],
)
def test_a_run_shows_results_and_its_answer(request, run, first, unit):
    folder = request.getfixturevalue(run)
    out, err = ((folder.parent / name).read_text() for name in ("out.txt", "err.txt"))
    assert out.startswith(first)
    assert out.splitlines()[-1] == f"report: {folder / 'report.html'}"
    conclusion = next(line for line in out.split("\n\n")[1].splitlines())
    assert conclusion.replace("'", "&#39;") in (folder / "report.html").read_text()
    assert len([line for line in err.splitlines() if line.endswith(f" {unit}")]) >= 4
    assert not {*json.loads((folder / "config.json").read_text())["config"]} & {"open", "quiet", "json"}


def test_quiet_runs_show_the_answer_alone(tmp_path, capsys):
    assert quick.run("rssi", "--rx", "1", "--quiet", "--out", tmp_path / "run") == 0
    out, err = capsys.readouterr()
    assert out.startswith("model")
    assert err == ""
    assert not terminal.console.quiet


def test_an_interrupted_run_says_how_to_resume(tmp_path, capsys, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("tasks.rssi.experiment._metrics", interrupt)
    assert quick.run("rssi", "--rx", "1", "--quiet", "--out", tmp_path / "run") == 130
    assert capsys.readouterr().err == f"stopped; continue with: swiftwrf resume {tmp_path / 'run.partial'}\n"
    monkeypatch.undo()
    assert quick.run("resume", tmp_path / "run.partial", "--json") == 0
    assert json.loads(capsys.readouterr().out)["rows"]
