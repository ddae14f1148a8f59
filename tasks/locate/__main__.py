"""Run `python -m tasks.locate --rx all`."""

import sys

from tasks.command import run_command

sys.exit(run_command("locate", sys.argv[1:]))
