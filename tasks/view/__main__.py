"""Run `python -m tasks.view RUN_OR_MODEL`."""

import sys

from tasks.command import run_command

sys.exit(run_command("view", sys.argv[1:]))
