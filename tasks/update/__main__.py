"""Run `python -m tasks.update MODEL DIR`."""

from tasks.command import run_module

raise SystemExit(run_module("tasks.update"))
