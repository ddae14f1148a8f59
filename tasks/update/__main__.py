"""Run `python -m tasks.update MODEL SOURCE --out NEW`."""

import sys

from tasks.command import run_command

sys.exit(run_command("update", sys.argv[1:]))
