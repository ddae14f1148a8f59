"""Commands: `swiftwrf aoa --mix 0.3`, or `python -m tasks.aoa --mix 0.3`.

The console script also works in a directory with a `tasks.py`, which `python -m tasks.aoa` would import in place of this
package. Options are parsed and checked before the modules that compute are imported, so help and refusals take no time.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from difflib import get_close_matches
from functools import partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple


class Command(NamedTuple):
    """A command of the console script."""

    options: str  # dataclass of the options, in `tasks.configs`; the first line of its docstring stands in the help
    module: str  # module with `run(config)`, or `run(config, resume)` if its runs can be resumed


COMMANDS = {
    "aoa": Command("AoaConfig", "tasks.aoa.experiment"),
    "rssi": Command("RssiTaskConfig", "tasks.rssi.experiment"),
    "locate": Command("LocateConfig", "tasks.locate.experiment"),
    "predict": Command("PredictConfig", "tasks.predict"),
    "plan": Command("PlanConfig", "tasks.plan"),
    "report": Command("ReportConfig", "tasks.report"),
    "inspect": Command("InspectConfig", "tasks.inspect"),
    "convert": Command("ConvertConfig", "tasks.convert"),
    "update": Command("UpdateConfig", "tasks.update.run"),
    "resume": Command("ResumeConfig", "tasks.resume"),
    "scenes": Command("ScenesConfig", "tasks.scenes"),
    "view": Command("ViewConfig", "tasks.view.sources"),
}
DRAWING = ("tasks.page.figures",)
BASELINES = ("sklearn.linear_model", "sklearn.gaussian_process", "sklearn.neighbors")
# modules that processes of a run load while the run itself begins
PRELOADED = {
    "aoa": ("augment.turbo.learning", "torchvision", "torch._dynamo", *DRAWING),
    "rssi": ("swiftwrf.contrib.comparison.rssi_baselines", *BASELINES, *DRAWING),
    "locate": ("swiftwrf.contrib.comparison.locating", *BASELINES, *DRAWING),
    "plan": DRAWING,
    "report": DRAWING,
    "update": DRAWING,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the console script with a command and its options, by default those of the process, and return its exit code.

    Returns:
        Exit code; see `tasks.command_line.command_line`.

    Example:
        >>> main(["--help"])  # doctest: +ELLIPSIS
        usage: swiftwrf COMMAND [OPTIONS]
        ...
        0
    """
    name, *options = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-V", "--version"):
        print(f"swiftwrf {version('swiftwrf-tasks')}")
        return 0
    if name in ("-h", "--help", "help") and options:
        name, options = options[0], ["--help"]
    if name in ("-h", "--help", "help"):
        from tasks import configs
        from tasks.command_line import without_reader
        from tasks.options import General, meanings

        try:
            print("usage: swiftwrf COMMAND [OPTIONS]\n")
            for name, command in COMMANDS.items():
                summary, *_ = getattr(configs, command.options).__doc__.splitlines()
                print(f"  {name:<9} {summary}")
            print("\noptions of all commands:\n")
            for option, meaning in meanings(General).items():
                print(f"  {option:<9} {meaning}")
            print("\noptions of a command: swiftwrf COMMAND --help", flush=True)
            print('completion of the shell: eval "$(swiftwrf completion bash)", or zsh, fish', flush=True)
        except BrokenPipeError:
            return without_reader()
        return 0
    if name == "completion":
        from swiftwrf.errors import InputError
        from tasks.completion import script

        try:
            print(script("".join(options), {name: command.options for name, command in COMMANDS.items()}))
        except InputError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        return 0
    if name not in COMMANDS:
        meant = [f"did you mean {close}?" for close in get_close_matches(name, COMMANDS, 1)]
        remedy = meant[0] if meant else f"choose from {', '.join(COMMANDS)}"
        print(f"error: unknown command {name!a}; {remedy}", file=sys.stderr)
        return 2
    return run_command(name, options, f"swiftwrf {name}")


def run_module(module: str) -> int:
    """Run the command of a module, `python -m tasks.inspect DIR`, and return its exit code."""
    return run_command(module.removeprefix("tasks."), sys.argv[1:], f"python -m {module}")


def run_command(name: str, options: Sequence[str], program: str) -> int:
    """Run a command of `COMMANDS`, under the name of its program in the help, and return its exit code."""
    if "OMP_WAIT_POLICY" not in os.environ:
        # threads that share a loop wait busily for milliseconds by default, which makes the steps of a network up to eight
        # times slower if other work uses the same cores; libgomp reads the variable when torch is loaded
        os.environ.setdefault("GOMP_SPINCOUNT", "30000")
    os.environ["MPLBACKEND"] = "agg"  # figures go into files, whatever a session has set for its windows
    if sys.stdout is None:  # closed by the caller, e.g. a timer
        sys.stdout = os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")
    with suppress(AttributeError):  # of a stream of a notebook
        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    gc.disable()  # loading libraries leaves no garbage, and to look for it takes a fifth of the time
    try:
        from tasks.command_line import command_line

        config_type = getattr(import_module("tasks.configs"), COMMANDS[name].options)
        return command_line(program, config_type, partial(run_task, name), options)
    finally:
        gc.enable()
        gc.freeze()  # the end of the interpreter would look through all objects for a second


def run_task(name: str, config: Any, *folder: Path) -> None:
    """Run a command with checked options, or continue its run in a directory."""
    from tasks.preload import preload

    preload(PRELOADED.get(name, ()) if getattr(config, "processes", None) != 1 else ())
    module = import_module(COMMANDS[name].module)
    gc.enable()
    module.run(config, *folder)
