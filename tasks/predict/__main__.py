"""Run `python -m tasks.predict MODEL SOURCE`."""

import sys

from tasks.command import run_command

sys.exit(run_command("predict", sys.argv[1:]))
