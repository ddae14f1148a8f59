"""A run: one directory with its configuration, environment, records and results; resumable, and whole or not there."""

from __future__ import annotations

import csv
import inspect
import json
import math
import os
import platform
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch
import tyro
from rich.console import Console

from swiftwrf import FitError, InputError
from swiftwrf.registry import Registry

PARTIAL = ".partial"  # suffix of a run that is not finished
console = Console(stderr=True, highlight=False)
Row = dict[str, Any]
Preset = Literal["quick", "paper"]
Config = TypeVar("Config")


def command_line(
    name: str,
    config_type: type[Config],
    task: Callable[[Config, Path | None], None],
    arguments: Sequence[str],
    more: Callable[[], str] | None = None,
) -> int:
    """Parses the arguments into `config_type`, runs the task and turns its errors into sentences and exit codes.

    `--resume DIR` takes the configuration from an interrupted run instead. The help says what the docstring of
    `config_type` does, and `more`.

    Returns:
        0: done; 2: wrong input, said in one sentence; 1: a fit that broke; 130: interrupted.
    """
    try:
        if arguments and arguments[0] == "--resume":
            if len(arguments) != 2:
                raise InputError(
                    "--resume takes one directory and no other option; the run's own configuration is used"
                )
            folder = Path(arguments[1])
            task(_saved_config(folder, config_type), folder)
        else:
            description = "\n\n".join([inspect.cleandoc(config_type.__doc__ or ""), *([more()] if more else [])])
            task(tyro.cli(config_type, prog=f"python -m {name}", description=description, args=arguments), None)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except FitError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except PermissionError as error:
        print(f"error: no permission to write {error.filename}; choose another --out", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def _saved_config(folder: Path, config_type: type[Config]) -> Config:
    file = folder / "config.json"
    if not file.is_file() or not folder.name.endswith(PARTIAL):
        raise InputError(f"{folder} is no interrupted run; expected a directory *{PARTIAL} with a config.json")
    values = json.loads(file.read_text())["config"]
    return config_type(**{name: tuple(v) if isinstance(v, list) else v for name, v in values.items()})


def choice(meaning: str, registry: Registry[Any]) -> Any:
    """Annotation of an option that takes names of a registry; its help lists what is registered when it is shown."""

    def entries(default: str) -> str:
        return f"{'; '.join(f'{entry.name}: {entry.meaning}' for entry in registry.entries())} (default: {default})"

    return tyro.conf.arg(help=f"{meaning}:", help_behavior_hint=entries)


def choose_device(name: str) -> torch.device:
    """The device of that name; `auto` is the GPU where there is one.

    Raises:
        InputError: a GPU asked for where there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda needs an NVIDIA GPU that torch can use, and there is none; use --device cpu")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(name)


class Run:
    """The directory of a run while it is being filled.

    It is made as `NAME.partial` and renamed to `NAME` by `finish`. What a step has computed is kept there, so that a
    resumed run goes on after it.

    Args:
        task: its name, the parent directory of runs without `--out`.
        out: where the run will lie, or None for a new directory under `runs/`.
        label: what to add to the time in the name of such a directory.
        config: a dataclass of plain values.
        device: where it computes.
        source: sha256 of the input's files by name.
        resume: the directory of an interrupted run to go on with.

    Raises:
        InputError: `out` exists already.
    """

    def __init__(
        self,
        task: str,
        out: str | None,
        label: str,
        config: Any,
        device: torch.device,
        source: dict[str, str],
        resume: Path | None = None,
    ) -> None:
        stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
        if resume is not None:
            self.final = resume.with_name(resume.name.removesuffix(PARTIAL))
        else:
            self.final = Path(out) if out else Path("runs") / task / f"{stamp}-{label}"
        self.folder = self.final.with_name(self.final.name + PARTIAL)
        if self.final.exists() or (resume is None and self.folder.exists()):
            taken = self.final if self.final.exists() else self.folder
            hint = "" if self.final.exists() else f" or go on with --resume {self.folder}"
            raise InputError(f"{taken} exists already and a run is never overwritten; choose another --out{hint}")
        self._environment = environment(device, source)
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "steps").mkdir(exist_ok=True)
        if resume is None:
            command = shlex.join(["python", "-m", f"tasks.{task}", *sys.argv[1:]])
            self.write_json("config.json", {"task": task, "command": command, "config": asdict(config)})

    def write_json(self, name: str, content: Any) -> None:
        """Strict JSON: nan and infinity become null."""
        text = json.dumps(_strict(content), indent=1, allow_nan=False, ensure_ascii=False)
        file = self.folder / name
        temporary = file.with_name(f".{file.name}")
        temporary.write_text(text + "\n")
        temporary.replace(file)

    def write_csv(self, name: str, rows: Iterable[Row]) -> None:
        """A table with the keys of the rows as columns."""
        rows = list(rows)
        columns = list(dict.fromkeys(key for row in rows for key in row))
        with (self.folder / name).open("w", newline="") as stream:
            writer = csv.DictWriter(stream, columns)
            writer.writeheader()
            writer.writerows(rows)

    def step(self, name: str, compute: Callable[[], Any]) -> Any:
        """What `compute` returns (plain values); computed once, also over a resumed run. Seconds are kept with it."""
        file = self.folder / "steps" / f"{name}.json"
        if not file.exists():
            console.print(f"[bold]{name}[/] ...", end=" " if not console.is_terminal else "\n")
            began = time.perf_counter()
            value = _strict(compute())
            self.write_json(f"steps/{name}.json", {"value": value, "seconds": time.perf_counter() - began})
            console.print(f"{time.perf_counter() - began:.1f} s")
        return json.loads(file.read_text())

    def path(self, name: str) -> Path:
        """A file in the run's directory."""
        return self.folder / name

    def finish(self, metrics: Mapping[str, Any], report: Callable[[Path, Row], None]) -> Path:
        """Writes environment, report and, last, metrics; removes what only a resumed run needs; gives the run its name."""
        self._environment["end"] = datetime.now(UTC).isoformat(timespec="seconds")
        self.write_json("environment.json", self._environment)
        strict: Row = _strict(metrics)
        report(self.folder, strict)
        self.write_json("metrics.json", strict)
        shutil.rmtree(self.folder / "steps", ignore_errors=True)
        self.folder.rename(self.final)
        return self.final

    def __enter__(self) -> Run:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if kind is None or not self.folder.exists():
            return
        if issubclass(kind, InputError):
            shutil.rmtree(self.folder)
        else:
            console.print(f"stopped; go on with [bold]--resume {self.folder}[/]")


def _strict(value: Any) -> Any:
    """The value as strict JSON carries it."""
    if isinstance(value, dict):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(item) for item in value]
    if isinstance(value, torch.Tensor):
        return _strict(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def environment(device: torch.device, source: dict[str, str]) -> Row:
    """Code, versions, machine and input of a run."""
    packages = ("torch", "torchvision", "numpy", "scipy", "scikit-learn", "numba")
    return {
        "commit": _commit(),
        "version": version("swiftwrf-tasks"),
        "python": platform.python_version(),
        "packages": {name: version(name) for name in packages},
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else _processor(),
        "threads": torch.get_num_threads(),
        "input_sha256": source,
        "start": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _commit() -> str | None:
    """Of the repository the code runs from, marked where files differ from it; None outside a repository."""
    with suppress(OSError, subprocess.CalledProcessError):
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"],
            cwd=Path(__file__).parent, capture_output=True, text=True, check=True,
        )  # fmt: skip
        return described.stdout.strip()
    return None


def _processor() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return f"{line.split(':', 1)[1].strip()}, {os.cpu_count()} cores"
    return f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
