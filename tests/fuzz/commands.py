"""Command lines as people mistype them and as hostile tools write them, and some that are right.

Those that are mistyped start no long run: whatever is valid among them meets an `--out` that is taken, or fails its check.
"""

import contextlib
import io
import json
import random
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import get_type_hints

import yaml
from quick import TASKS

from fuzz.mutate import mutated
from swiftwrf import InputError
from swiftwrf.runtime.validation import check_value
from tasks.command_line import execute, from_names
from tasks.options import General, ReadingOptions, by_name

VALUES = [
    "", "0", "1", "-1", "0.5", "1.5", "nan", "inf", "-inf", "1e400", "1e-320", "4294967296", "99999999999999999999",
    "all", "x", "random", "block", "nowhere", "--", "-", "\u00e4", "\udcff", "a\nb", "$x^{$", "=1", "x" * 300, ".", "..",
    "/", "/dev/null", "/proc/1/mem", "tcp://127.0.0.1:1", "tls://127.0.0.1:1", "none", "auto", "cpu", "paper", "True",
    "[1]", "{}", "nearest", "swiftwrf", "receiver", "*",
]  # fmt: skip
EVERYWHERE = by_name(General()) | by_name(ReadingOptions())  # not every command takes them
OPTIONS = {
    task: [f"--{name.replace('_', '-')}" for name in by_name(from_names(config, {}, "")) | EVERYWHERE]
    for task, (config, _) in TASKS.items()
}
REQUIRED_OPTIONS = {
    "aoa": ["--mix", "0.5"],
    "rssi": ["--rx", "1"],
    "report": ["run"],
    "resume": ["broken.partial"],
    "convert": ["data", "taken"],
    "inspect": ["data"],
    "view": ["data"],
    "plan": ["data"],
    "scenes": ["--room", "office", "--moving", "receiver", "--positions", "5"],
    "predict": ["data", "data"],
    "locate": ["--cells", "100"],
    "update": ["model", "data"],
}


def command_lines(draw: random.Random, folder: Path, count: int) -> Iterator[tuple[str, list[str]]]:
    """Yield `count` random command lines with paths inside the folder."""
    taken, broken = folder / "taken", folder / "broken.partial"
    taken.mkdir()
    broken.mkdir()
    (broken / "config.json").write_text('{"task": "rssi", "config": {}}')
    (folder / "data").mkdir()
    values = [*VALUES, str(taken), str(broken), str(folder / "data")]
    for _ in range(count):
        task = draw.choice(list(OPTIONS))
        arguments = list(REQUIRED_OPTIONS[task]) if draw.random() < 0.8 else []
        for _ in range(draw.randint(0, 3)):
            arguments.append(draw.choice(OPTIONS[task]))
            arguments += [draw.choice(values) for _ in range(draw.choice([0, 1, 1, 1, 2, 3, 4]))]
        if draw.random() < 0.1:
            arguments.append(draw.choice(values))
        yield task, arguments if task in ("convert", "resume", "view") else [*arguments, "--out", str(taken)]


SAVED = {
    "rssi": {"rx": ["1", "receiver06"], "split": "block", "seed": 7, "data": None},
    "aoa": {"mix": [0.5, 1.0], "synthesizer": ["idw"], "extra": 7, "seed": 3},
    "convert": {"source": "data", "out": "new", "cell": 0.5, "rx": ["1"], "columns": ["x=lon"], "filler": [100.0]},
    "update": {"model": "model", "source": "data", "out": "new", "false_alarm_rate": 0.001, "follow": False},
}


def config_file(draw: random.Random, folder: Path) -> None:
    """Take the options of a command from a mutated file.

    Raises:
        InputError: The file is refused.
        AssertionError: A value is not of the type of its option.
    """
    task, suffix = draw.choice(list(SAVED)), draw.choice([".json", ".yaml"])
    text, found = json.dumps(SAVED[task]) if suffix == ".json" else yaml.safe_dump(SAVED[task]), []
    file = folder / f"options{suffix}"
    file.write_bytes(mutated(text.encode(), draw, words_only=draw.random() < 0.5))
    options = [f"--config={file}"] if draw.random() < 0.5 else ["--config", str(file)]
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            execute(f"tasks.{task}", TASKS[task][0], lambda config, *_: found.append(config), options)
    except SystemExit as end:  # a required option is missing
        raise InputError(f"the parser ends with {end.code}") from None
    for group in (found[0], *filter(is_dataclass, vars(found[0]).values())):
        hints = get_type_hints(type(group), include_extras=True)
        for option in fields(group):
            try:
                check_value(option.name, getattr(group, option.name), hints[option.name])
            except InputError as error:
                raise AssertionError(error) from None
