"""Help, files of options and messages of every command."""

from __future__ import annotations

import json
import logging
import re
from dataclasses import fields
from importlib import import_module

import pytest
from quick import said

from swiftwrf import InputError
from tasks.aoa.options import AoaConfig
from tasks.command import COMMANDS, main
from tasks.command_line import command_line
from tasks.inspect.options import InspectConfig
from tasks.options import plain
from tasks.parsing import parse
from tasks.report.options import ReportConfig
from tasks.rssi.options import RssiTaskConfig

SOURCE = ("--data", "x", "--array", "4", "2", "0.06", "2.4e9", "--drop-null")


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_groups_names_examples_and_one_default_an_option(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    with pytest.raises(SystemExit, match="0"):
        main([name, "--help"])
    text = capsys.readouterr().out
    options = re.split(r"^[│ ] (?=-|[A-Z\[])", text, flags=re.MULTILINE)[1:]
    assert all(option.count("(default") + option.count("(required)") <= 1 for option in options)
    assert "default: None" not in text
    assert f"Example: python -m tasks.{name} " in text
    config_type = getattr(import_module(f"tasks.{name}.options"), COMMANDS[name].options)
    listed = [match[1] for option in options if (match := re.match(r"--([a-z-]+)", option))]
    assert ("resume" in listed) == config_type.resumable
    assert {"config", "verbose"} <= {*listed}
    for option in fields(config_type):
        assert option.name.replace("_", "-") in listed or option.name.upper() in text.splitlines()[0]
    if "required options" in text:
        others = [
            text.index(f"{group} options") for group in ("command", "output", "general") if f"{group} options" in text
        ]
        assert text.index("required options") < min(others)


def test_a_run_is_repeated_from_its_configuration_and_the_command_line_wins(tmp_path):
    first = parse(AoaConfig, ["--mix", "0.1", "0.3", "--seed", "7", *SOURCE], "aoa")
    (tmp_path / "config.json").write_text(json.dumps({"task": "aoa", "config": plain(first)}))
    assert parse(AoaConfig, ["--config", str(tmp_path / "config.json")], "aoa") == first
    for given in (("--mix", "0.5"), ("--mix=0.5",)):
        again = parse(AoaConfig, [*given, "--config", str(tmp_path / "config.json")], "aoa")
        assert plain(again) == plain(first) | {"mix": (0.5,)}
    rssi = parse(
        RssiTaskConfig, ["--rx", "1", "a b", "--floor-plan", "p", "--floor-extent", "-1", "2", "0", "1"], "rssi"
    )
    (tmp_path / "rssi.json").write_text(json.dumps(plain(rssi)))
    assert parse(RssiTaskConfig, ["--config", str(tmp_path / "rssi.json")], "rssi") == rssi


def test_a_yaml_file_holds_options_and_positional_arguments(tmp_path):
    file = tmp_path / "inspect.yaml"
    file.write_text("source: DIR\nevery: 3\nround_trip: true\ncolumns: [x=a, y=b]\nout: null\n")
    found = parse(InspectConfig, ["--config", str(file)], "inspect")
    assert (found.source, found.every, found.round_trip, found.columns, found.out) == (
        "DIR",
        3,
        True,
        ("x=a", "y=b"),
        None,
    )
    assert parse(InspectConfig, ["OTHER", "--config", str(file)], "inspect").source == "OTHER"


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (None, "cannot be read"),
        ("mix: [0.3", "cannot be read"),
        ("- 0.3", "must hold options by name, got list"),
        ("mixx: 0.3", "names 'mixx', which is no option of this command; --help lists them"),
    ],
)
def test_files_that_hold_no_options_are_refused(tmp_path, content, sentence):
    file = tmp_path / "options.yaml"
    if content is not None:
        file.write_text(content)
    with pytest.raises(InputError, match=sentence):
        parse(AoaConfig, ["--config", str(file)], "aoa")


def test_values_of_a_file_are_checked_as_those_of_a_command_line(tmp_path, capsys):
    (tmp_path / "options.yaml").write_text("mix: [0.3]\nseed: many\n")
    with pytest.raises(SystemExit, match="2"):
        parse(AoaConfig, ["--config", str(tmp_path / "options.yaml")], "aoa")
    assert "--seed" in capsys.readouterr().err
    with pytest.raises(InputError, match="--config takes a file"):
        parse(AoaConfig, ["--config"], "aoa")
    assert main(["aoa", "--mix", "0.3", "--resume", "x"]) == 2
    assert "--resume DIR.partial comes first" in said(capsys)


def test_verbose_prints_messages_of_logging_and_only_during_the_command(capsys):
    def task(config):
        logging.getLogger("swiftwrf.data").info("reading %s", config.runs[0])

    for options, shown in ((["first", "--verbose"], True), (["first"], False)):
        assert command_line("tasks.report", ReportConfig, task, options) == 0
        assert ("reading first" in capsys.readouterr().err) == shown
    assert not logging.getLogger("swiftwrf").handlers
