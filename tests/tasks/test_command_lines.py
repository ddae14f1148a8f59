"""Command lines that cannot be: each ends in one sentence and exit code 2, and leaves nothing."""

import os

import pytest
import torch
from quick import run, said


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
        ("locate", ("--cells", 9), "--cells must be a whole number at least 10"),
        ("aoa", ("--mix", 0.5, "--processes", 0), "--processes must be a whole number at least 1, got 0"),
        ("rssi", ("--rx", "1", "--out", "link"), "link exists already"),
        ("report", ("{file}", "--out", "link"), "no finished run"),
        ("predict", ("{file}", "{file}", "--out", "link"), "link exists already"),
        ("locate", ("--columns", "x=a"), "give it with --data"),
        ("locate", ("--scheduler", "tcp://127.0.0.1:1"), "no Dask scheduler"),
        ("predict", ("{file}", "{file}", "--out", "{file}-new.csv"), "not a readable safetensors file"),
        ("report", ("{file}",), "no finished run"),
        ("report", ("--out", "{file}/x"), "no runs"),
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
    with Run("rssi", None, label, RssiTaskConfig(("1",)), torch.device("cpu"), {}) as directory:
        name = directory.final.name
    assert len(name) < 100
    assert "/" not in name


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read and write everything")
def test_unreadable_data_are_told_from_unwritable_directories(tmp_path, capsys):
    (tmp_path / "data").mkdir(mode=0)
    assert run("rssi", "--rx", "1", "--data", tmp_path / "data") == 2
    assert "write" not in said(capsys)
