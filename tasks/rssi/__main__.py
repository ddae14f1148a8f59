"""Run `python -m tasks.rssi --rx 6`."""

from tasks.command import run_module

raise SystemExit(run_module("tasks.rssi"))
