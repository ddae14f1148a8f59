"""Run `python -m tasks.convert SOURCE OUT`."""

import sys

from tasks.command import run_command

sys.exit(run_command("convert", sys.argv[1:]))
