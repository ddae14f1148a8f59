"""Run `python -m tasks.view RUN`."""

from tasks.command import run_module

raise SystemExit(run_module("tasks.view"))
