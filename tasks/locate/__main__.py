"""Run `python -m tasks.locate --data DIR`."""

from tasks.command import run_module

raise SystemExit(run_module("tasks.locate"))
