"""Run `python -m tasks.resume runs/aoa/first.partial`."""

import sys

from tasks.command import run_command

sys.exit(run_command("resume", sys.argv[1:]))
