"""Help, files of options and messages of every command."""

import json
import logging
import os
import re
from dataclasses import fields, is_dataclass
from unittest import mock

import pytest
import yaml

from swiftwrf import InputError
from swiftwrf.runtime.digest import digest
from swiftwrf.runtime.durable import strict
from tasks import configs
from tasks.command import COMMANDS, main
from tasks.command_line import command_line, execute, file_options, from_names, parse
from tasks.configs import AoaConfig, InspectConfig, ReportConfig, RssiTaskConfig
from tasks.options import by_name
from tasks.terminal import terminal

SOURCE = ("--data", "x", "--read", "reading.yaml")


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_groups_names_examples_and_one_default_an_option(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    with pytest.raises(SystemExit, match="0"):
        main([name, "--help"])
    text = capsys.readouterr().out
    assert text.startswith(f"usage: swiftwrf {name} ")
    options = re.split(r"^[│ ] (?=-|[A-Z\[])", text, flags=re.MULTILINE)[1:]
    assert all(option.count("(default") + option.count("(required)") <= 1 for option in options)
    assert "default: None" not in text
    assert f"Example: swiftwrf {name} " in text
    config_type = getattr(configs, COMMANDS[name].options)
    assert "General options, see swiftwrf --help: --config, --verbose, --quiet, --json, --open" in text
    groups = [option.name for option in fields(config_type) if is_dataclass(option.default)]
    places = [text.index(f" {group} options ") for group in groups]
    assert places == sorted(places)
    for name in by_name(from_names(config_type, {}, "")):
        assert f"--{name.replace('_', '-')}" in text or name.upper() in text.splitlines()[0]


def test_a_run_is_repeated_from_its_configuration_and_the_command_line_wins(tmp_path):
    first = parse(AoaConfig, ["--mix", "0.1", "0.3", "--seed", "7", *SOURCE], "aoa")
    (tmp_path / "config.json").write_text(json.dumps({"task": "aoa", "config": by_name(first)}))
    assert parse(AoaConfig, [], "aoa", file_options(tmp_path / "config.json")) == first
    for given in (("--mix", "0.5"), ("--mix=0.5",)):
        again = parse(AoaConfig, given, "aoa", file_options(tmp_path / "config.json"))
        assert by_name(again) == by_name(first) | {"measured": (0.5,)}
    options = ["--rx", "1", "a b", "--floor-plan", "p", "--floor-extent", "-1", "2", "0", "1"]
    rssi = parse(RssiTaskConfig, options, "rssi")
    (tmp_path / "rssi.json").write_text(json.dumps(by_name(rssi)))
    assert parse(RssiTaskConfig, [], "rssi", file_options(tmp_path / "rssi.json")) == rssi


def test_a_yaml_file_holds_options_and_positional_arguments(tmp_path):
    file = tmp_path / "inspect.yaml"
    file.write_text("source: DIR\nevery: 3\nround_trip: true\ncolumns: [x=a, y=b]\nout: null\narray: [4, 0.1, 915e6]\n")
    found = parse(InspectConfig, [], "inspect", file_options(file))
    assert (found.source, found.out, found.reading.columns) == ("DIR", None, ("x=a", "y=b"))
    assert (found.reading.every, found.reading.round_trip, found.reading.array) == (3, True, (4, 0.1, 915e6))
    assert parse(InspectConfig, ["OTHER"], "inspect", file_options(file)).source == "OTHER"


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (None, "cannot be read"),
        ("mix: [0.3", "cannot be read"),
        ("[" * 5000, "cannot be read"),
        ("#" * 2**20 + "\n", "at most 1048576 bytes"),
        ("- 0.3", "must hold options by name, got list"),
        ("mixx: 0.3", "names 'mixx', which is no option of this command; --help lists them"),
        ("mix: [0.3]\nseed: many\n", "o.yaml: seed must be a whole number at least 0 .*, got 'many'"),
        ("seed: [1, 2]\n", "seed must be"),
        ("every: 2\n", "names 'every', which is no option of this command"),
        ("preset: large\n", "preset must be 'quick' or 'paper', got 'large'"),
        ("a: &a [x, x]\nsynthesizer: [*a, *a]\n", "models must be a tuple of a text"),
        ("models: [[x]]\n", "models must be"),
    ],
)
def test_a_file_of_options_is_checked_as_a_command_line(tmp_path, content, sentence):
    if content is not None:
        (tmp_path / "o.yaml").write_text(content)
    with pytest.raises(InputError, match=sentence):
        parse(AoaConfig, [], "aoa", file_options(tmp_path / "o.yaml"), "o.yaml")


def executed(config_type, *arguments):
    """Return the configuration with which a command line runs its task, and the general options."""
    found = []
    execute("tasks.rssi", config_type, lambda config: found.extend([config, terminal.options]), [*map(str, arguments)])
    return found


@pytest.mark.parametrize(
    ("content", "options", "expected"),
    [
        (
            {"seed": 5, "split": "block", "rx": [1, "a b"]},
            ("--seed", 6),
            {"seed": 6, "split": "block", "receivers": ("1", "a b")},
        ),
        ({"receivers": 1, "json": True}, (), {"json": True}),
        ({"rx": [1], "json": True}, ("--no-json", "--quiet"), {"json": False, "quiet": True}),
        *(
            ({"rx": texts}, (), {"receivers": tuple(texts), "out": None})  # values of a file are no flags
            for texts in (["--out", "X"], ["--help"], ["--config=x"], ["-1"])
        ),
    ],
)
@pytest.mark.parametrize("form", [lambda file: ("--config", file), lambda file: (f"--config={file}",)])
def test_a_file_of_options_is_given_in_both_forms_and_the_command_line_wins(tmp_path, content, options, expected, form):
    (tmp_path / "opts.yaml").write_text(yaml.safe_dump(content))
    config, general = executed(RssiTaskConfig, *form(tmp_path / "opts.yaml"), *options)
    found = vars(config) | vars(general)
    assert {name: found[name] for name in expected} == expected


def test_the_configuration_of_a_run_with_out_starts_another_run(tmp_path):
    values = by_name(RssiTaskConfig(("1",), out=str(tmp_path), data="x", read="reading.yaml"))
    (tmp_path / "config.json").write_text(json.dumps({"task": "rssi", "config": values}))
    found, _ = executed(RssiTaskConfig, "--config", tmp_path / "config.json")
    assert by_name(found) == values | {"out": None}
    again, general = executed(RssiTaskConfig, "--config", tmp_path / "config.json", "--json", "--out", "other")
    assert (again.out, general.json) == ("other", True)


@pytest.mark.parametrize("words", [("--filler", "-100", "100"), ("--filler=none",), ("--y-down",)])
def test_options_of_reading_are_those_of_inspect_and_other_commands_say_so(words):
    parsed = executed(InspectConfig, "x", *words)[0].reading
    assert parsed.filler in ((-100.0, 100.0), "none", ())
    name = words[0].partition("=")[0]
    sentence = f"{name} is no option of this command; give {name} to swiftwrf inspect, .* by --read FILE.yaml"
    with pytest.raises(InputError, match=sentence):
        executed(RssiTaskConfig, "--rx", "1", "--data", "x", *words)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--config", "a", "--config=b"), "--config is given twice: a and b"),
        (("--config",), "--config: expected one argument"),
        (("--config", "/dev/zero"), "cannot be read"),
        (("--config", "fifo"), "cannot be read"),
    ],
)
def test_general_options_are_refused_in_a_sentence(tmp_path, monkeypatch, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("fifo")
    with pytest.raises(InputError, match=sentence):
        executed(RssiTaskConfig, "--rx", 1, *arguments)


@pytest.mark.parametrize(("name", "text"), [("a.yml", "seed: 1\nseed: 2\n"), ("a.json", '{"seed": 1, "seed": 2}')])
def test_an_option_given_twice_in_a_file_is_refused(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match="it names 'seed' twice; each needs a name of its own"):
        executed(RssiTaskConfig, "--rx", 1, "--config", tmp_path / name)


@pytest.mark.parametrize("given", [("--seed", "7"), ("--data", "x"), ("--split", "block")])
def test_resume_changes_no_result(tmp_path, given, capsys):
    folder = tmp_path / "x.partial"
    folder.mkdir()
    values = by_name(RssiTaskConfig(("1",), scheduler="tcp://old:1"))
    (folder / "config.json").write_text(json.dumps({"task": "rssi", "config": values}))
    (folder / "environment.json").write_text(json.dumps({"config_sha256": digest(strict(values))}))
    with mock.patch("tasks.resume.run_task") as task:
        assert main(["resume", str(folder), "--json"]) == 0
        assert main(["resume", str(folder), "--scheduler", "tcp://new:1"]) == 0
        with pytest.raises(SystemExit, match="2"):
            main(["resume", str(folder), *given])
    first, second = [call.args for call in task.call_args_list]
    assert (first[0], by_name(first[1]), first[2]) == ("rssi", values | {"scheduler": None}, folder)
    assert second[1].scheduler == "tcp://new:1"
    assert f"Unrecognized options: {given[0]}" in " ".join(capsys.readouterr().err.replace("│", "").split())


def test_verbose_prints_messages_of_logging_and_only_during_the_command(capsys):
    def task(config):
        logging.getLogger("swiftwrf.data").info("reading %s", config.runs[0])

    for options, shown in ((["first", "--verbose"], True), (["first"], False)):
        assert command_line("tasks.report", ReportConfig, task, options) == 0
        assert ("reading first" in capsys.readouterr().err) == shown
    assert not logging.getLogger("swiftwrf").handlers
