"""Run `python -m tasks.inspect SOURCE`."""

import sys

from tasks.command import run_command

sys.exit(run_command("inspect", sys.argv[1:]))
