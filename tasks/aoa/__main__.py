"""Run `python -m tasks.aoa --mix 0.3`."""

from tasks.command import run_module

raise SystemExit(run_module("tasks.aoa"))
